"""The process that renders: mitsuba and mitransient live here and nowhere else.

Run as `python -m lidardesign.simulate.light_transport_worker`. Every line on standard input names a folder with
`request.json` (numbers, shapes) and `request.npz` (arrays); the answer is `result.npz` or `error.txt` in that folder
and one line on standard output. A library that aborts takes this process down, not the program that asked.

Transport (intersections, scattering, several bounces, times of flight) is mitransient's `transient_path`. Its ends are
ours, `light_transport_ends`, because no stock sensor is a list of rays and no stock emitter a list of lit patches.
"""

from __future__ import annotations

import json
import sys
import traceback
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.numerics import TINY_FLOAT32
from lidardesign.simulate import light_transport_ends as ends

# Plain float32 on the CPU, one channel: light of one wavelength.
VARIANT = "llvm_ad_mono"


def _surface(shape: dict[str, Any]) -> dict[str, Any]:
    """Matt, mirroring and clear shares of a body's light as one material, the same on both sides."""
    clear, mirror = shape["transmission"], shape["specular"]
    solid = max(1.0 - clear, TINY_FLOAT32)
    matt_share = max(solid - mirror, TINY_FLOAT32)
    material: dict[str, Any] = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 1.0}}
    material["reflectance"]["value"] = min(shape["reflectance"] / matt_share, 1.0)
    if mirror > 0:
        glossy = {"type": "conductor", "material": "none"}
        material = {"type": "blendbsdf", "weight": mirror / solid, "matt": material, "glossy": glossy}
    material = {"type": "twosided", "inner": material}
    if clear > 0:
        material = {"type": "mask", "opacity": 1.0 - clear, "inner": material}
    return material


def _shapes(mi: Any, request: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    made: dict[str, Any] = {}
    for number, shape in enumerate(request["shapes"]):
        surface = _surface(shape)
        name = f"body{number}"
        if shape["kind"] == "mesh":
            made[name] = _mesh(mi, name, surface, arrays[f"vertices{number}"], arrays[f"faces{number}"])
            continue
        ends, radius = shape["ends"], shape["radius"]
        for end, centre in enumerate(ends[: 1 if ends[0] == ends[1] else 2]):
            made[f"{name}_{end}"] = {"type": "sphere", "center": centre, "radius": radius, "bsdf": surface}
        if ends[0] != ends[1]:
            made[name] = {"type": "cylinder", "p0": ends[0], "p1": ends[1], "radius": radius, "bsdf": surface}
    return made


def _mesh(mi: Any, name: str, surface: dict[str, Any], vertices: np.ndarray, faces: np.ndarray) -> Any:
    properties = mi.Properties()
    properties["surface"] = mi.load_dict(surface)
    mesh = mi.Mesh(name, vertex_count=len(vertices), face_count=len(faces), props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ascontiguousarray(vertices, dtype=np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(faces, dtype=np.uint32).ravel()
    parameters.update()
    return mesh


def _render(mi: Any, dr: Any, request: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    samples, rays = int(request["samples"]), len(arrays["origin"])
    film = {
        "type": "transient_hdr_film",
        "width": rays,
        "height": 1,
        "rfilter": {"type": "box"},
        "temporal_bins": int(request["bins"]),
        "bin_width_opl": float(request["width_m"]),
    }
    scene = mi.load_dict(
        {
            "type": "scene",
            **_shapes(mi, request, arrays),
            "lights": {"type": "lidardesign_lights"},
            "sensor": {
                "type": "lidardesign_rays",
                "film": film,
                "sampler": {"type": "independent", "sample_count": samples},
            },
        }
    )
    # a path of n surfaces has depth n + 1, the light counted
    depth = int(request["bounces"]) + 1
    integrator = mi.load_dict({"type": "transient_path", "max_depth": depth, "rr_depth": depth})
    ends.current[:] = [ends.Job(mi, dr, arrays, samples, bool(request["own"]))]
    steady, transient = integrator.render(scene, seed=int(request["seed"]), spp=samples)
    binned = np.asarray(transient)[0, :, :, 0]
    ray, cell = np.nonzero(binned)
    return {"ray": ray, "cell": cell, "radiance": binned[ray, cell], "steady": np.asarray(steady)[0, :, 0]}


def answer(folder: Path, mi: Any, dr: Any) -> None:
    """Render the request in a folder and leave the result or the error beside it."""
    try:
        request = json.loads((folder / "request.json").read_text(encoding="utf-8"))
        with np.load(folder / "request.npz", allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        np.savez(folder / "result.npz", **_render(mi, dr, request, arrays))
    except Exception:
        # whatever goes wrong in here is the asking side's to report
        (folder / "error.txt").write_text(traceback.format_exc(), encoding="utf-8")


def main() -> None:
    """Serve requests until standard input ends."""
    import drjit as dr
    import mitsuba as mi

    mi.set_variant(VARIANT)
    import mitransient  # noqa: F401 (registers its integrator and film)

    ends.register(mi, dr)
    print("ready", flush=True)
    for line in sys.stdin:
        answer(Path(line.rstrip("\n")), mi, dr)
        print("done", flush=True)


if __name__ == "__main__":
    main()
