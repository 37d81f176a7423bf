"""Which optional effects there are, and the settings that a detector measures with."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass

from lidardesign.errors import ConfigError
from lidardesign.run.validation import suggest
from lidardesign.scene import Scene
from lidardesign.simulate.detector.detector import IDEAL, Detector

# In the order in which light meets them; each is a module of `simulate.effects`, with what it could change (`bound`).
EFFECTS = {
    "footprint": "beams have a width: mixed pixels, several returns",
    "motion": "things move within a frame",
    "specular": "mirrors and glass lead light elsewhere",
    "multipath": "light comes back by way of other surfaces",
    "shadowing": "the receiver may not see what the emitter lights",
    "atmosphere": "the air weakens light and sends some of it back",
    "photon_noise": "light comes in photons",
    "jitter": "photons are timed with an error",
    "ambient": "light of the surroundings and dark counts",
    "pile_up": "a detector is blind after a count",
    "quantisation": "times are rounded to bins",
}
# Where one of these is on, photons are counted; without them a detector reports the strongest echo.
COUNTED = frozenset({"photon_noise", "jitter", "ambient", "pile_up", "quantisation", "atmosphere"})


@dataclass(frozen=True)
class Physics:
    """A detector and the effects that are simulated.

    Arguments:
        detector: How returns are measured.
        effects: Names out of `EFFECTS`.
        seed: Root of every effect's own random stream.
        repeat: Which time the scene is measured: rays that are fired again from elsewhere meet other chance.

    Raises:
        ConfigError: An unknown effect; all are listed.
    """

    detector: Detector = IDEAL
    effects: frozenset[str] = frozenset()
    seed: int = 0
    repeat: int = 0

    def __post_init__(self) -> None:
        check_effects(self.effects)

    def stream(self, effect: str, scene: Scene, frame: int) -> int:
        """The key of an effect's random numbers in a frame of a scene; no other effect changes them."""
        again = (str(self.repeat),) if self.repeat else ()
        label = "\0".join((str(self.seed), effect, scene.name, str(frame), *again))
        return int.from_bytes(hashlib.sha256(label.encode()).digest()[:8], "little")


def check_effects(names: Iterable[str]) -> None:
    """Refuse names that are no effects.

    Raises:
        ConfigError: An unknown effect; all are listed.
    """
    for name in sorted(set(names) - EFFECTS.keys()):
        hint = suggest(name.lower(), EFFECTS)
        raise ConfigError(f"unknown effect {name!r}", where="effects", allowed=", ".join(EFFECTS), hint=hint)


