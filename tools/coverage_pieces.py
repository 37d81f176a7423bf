"""The suite with every line and branch that it takes, a folder of tests after the other: `make coverage`.

Interrupted and started again it goes on behind the folders that are done.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
COVERAGE = (sys.executable, "-m", "coverage")


def parts() -> list[list[str]]:
    """Folders that hold tests, and the files beside them."""
    tests = ROOT / "tests"
    folders = sorted({path.relative_to(tests).parts[0] for path in tests.glob("*/**/test_*.py")})
    files = sorted(str(path.relative_to(ROOT)) for path in tests.glob("test_*.py"))
    return [*([f"tests/{name}"] for name in folders), files]


def main() -> int:
    """Run what is not done, and combine; raises where tests fail."""
    sys.path.insert(0, str(ROOT))
    from benchmarks.soak.long_runs import OURS, kept

    data = OURS / "coverage"
    data.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "COVERAGE_FILE": str(data / ".coverage")}
    for part in parts():
        words = [*COVERAGE, "run", "-m", "pytest", *part]
        kept(" ".join(words), lambda words=words: subprocess.run(words, cwd=ROOT, env=environment, check=True).args)
    return subprocess.run([*COVERAGE, "combine", "--keep", str(data)], cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
