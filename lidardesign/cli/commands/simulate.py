"""`lidardesign simulate`: write what a design sees, as clouds of points."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lidardesign.cli.terminal import options
from lidardesign.cli.terminal.grids import RichConsole
from lidardesign.cli.terminal.output import announce, command
from lidardesign.errors import ConfigError
from lidardesign.run.clock import phase
from lidardesign.run.outputs import check_outputs

FORMATS = "ply|pcd|mcap"


def simulate(
    target: Annotated[
        Path, typer.Argument(metavar="RUN|DESIGN", readable=False, help="A design, or a run folder with a single one.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="PATH", help="Folder to write; for mcap the file.")],
    format_: Annotated[
        str,
        typer.Option(
            "--format",
            metavar=FORMATS,
            help="Format of the clouds.",
            autocompletion=options.words(FORMATS),
        ),
    ] = "ply",
    scenes: Annotated[int, typer.Option("--scenes", metavar="N", help="Number of held-out scenes.")] = 1,
    scene: Annotated[
        Path | None,
        typer.Option("--scene", metavar="FILE", help="A mesh or MuJoCo model of your own instead.", show_default=False),
    ] = None,
    scale: Annotated[
        float, typer.Option("--scale", metavar="FACTOR", help="From the unit of that mesh to metres.")
    ] = 1.0,
    rays: options.RayCount = None,
    detector: options.Detector = "ideal",
    overrides: options.SceneSettings = None,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
) -> None:
    """Write what a design sees, as clouds of points."""
    with command(json=json, quiet=quiet, verbose=verbose) as output:
        with phase("libraries"):
            from lidardesign.api.design import collect_designs
            from lidardesign.clouds.files import FORMATS as KNOWN
            from lidardesign.clouds.files import write_clouds
            from lidardesign.clouds.seen import Measuring

        if format_ not in KNOWN:
            raise ConfigError(f"unknown format {format_!r}", where="--format", allowed=", ".join(KNOWN))
        designs = collect_designs([target], notes=output.remark)
        if len(designs) > 1:
            names = ", ".join(str(design.path) for design in designs)
            raise ConfigError(f"{target} has {len(designs)} designs", where="RUN|DESIGN", allowed=f"one of {names}")
        announce([out], output)
        check_outputs({"--out": out}, [scene] if scene else [], () if format_ == "mcap" else ("--out",))
        measuring = Measuring(detector, seed)
        choices = {"scenes": scenes, "rays": rays, "settings": overrides or (), "scale": scale}
        seen = designs[0].seen(measuring, scene, **choices, notes=output.remark)
        with phase("writing"):
            notes = write_clouds(seen, out, format_)
        for note in notes:
            output.remark(note)
        if not any(one.returned.any() for each in seen for one in each.returns):
            output.remark("no ray returns: check that the scene stands where sensors look, in metres (--scale)")
        counts = [sum(int(one.returned.sum()) for one in each.returns) for each in seen]
        document = {
            "design": str(designs[0].path),
            "out": str(out),
            "format": format_,
            "scenes": [
                {"name": each.scene.name, "frames": len(each.returns), "returns": count, "effects": list(each.effects)}
                for each, count in zip(seen, counts, strict=True)
            ],
        }

        def show(rich: RichConsole) -> None:
            frames = sum(len(each.returns) for each in seen)
            scenes_text = "1 scene" if len(seen) == 1 else f"{len(seen)} scenes"
            frames_text = "1 frame" if frames == 1 else f"{frames} frames"
            rich.print(f"wrote {out} ({scenes_text}, {frames_text}, {sum(counts)} returns)", soft_wrap=True)

        output.result(document, show, files={"wrote": out} if output.quiet else None, says_time=True)
