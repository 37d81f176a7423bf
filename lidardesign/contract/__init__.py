"""The contracts of plugins as testable laws: from Python, by `check` of each kind and in pytest.

`check_task(MyTask())` tries all of them; the modules are the groups of laws: `interface`, `scenes`,
`scoring` and `contract`. The names here are loaded when they are used.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "BrokenLawError": "law",
    "Finding": "law",
    "Law": "law",
    "LAWS": "contract",
    "Contract": "contract",
    "check_task": "contract",
    "contract_of": "contract",
    "contract_of_plugin": "contract",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
