"""What each optional effect could change in a scene, in closed form: the planner's reasons, one effect a module.

A module has `absent(detector, scene, lists)`, the reason why the effect can change nothing (known without casting a
ray) or None, and `stake(sight, counts)`, what it could change of every ray.
"""

from __future__ import annotations

from lidardesign.simulate.effects import (
    ambient,
    atmosphere,
    footprint,
    jitter,
    motion,
    multipath,
    photon_noise,
    pile_up,
    quantisation,
    shadowing,
    specular,
)

MODULES = {
    "footprint": footprint,
    "motion": motion,
    "specular": specular,
    "multipath": multipath,
    "shadowing": shadowing,
    "atmosphere": atmosphere,
    "photon_noise": photon_noise,
    "jitter": jitter,
    "ambient": ambient,
    "pile_up": pile_up,
    "quantisation": quantisation,
}
