"""`lidardesign simulate`: write what a design sees, as clouds of points."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lidardesign.choices.files import CLOUD_FORMATS, SimulateChoices, SimulateCommand
from lidardesign.choices.shared import Printed
from lidardesign.cli.terminal.grids import RichConsole
from lidardesign.cli.terminal.options import command_line
from lidardesign.cli.terminal.output import Output, announce
from lidardesign.errors import ConfigError, check_choice
from lidardesign.run.clock import phase
from lidardesign.run.markup import counted
from lidardesign.run.outputs import check_outputs


@command_line(SimulateCommand, SimulateChoices, Printed)
def simulate(
    output: Output,
    target: Annotated[
        Path, typer.Argument(metavar="RUN|DESIGN", readable=False, help="A design, or a run folder with a single one.")
    ],
    *,
    out: Path,
    format: str,
    scene: Path | None = None,
    **choices: Any,
) -> None:
    """Write what a design sees, as clouds of points."""
    with phase("libraries"):
        from lidardesign.api.contenders import collect_designs
        from lidardesign.clouds.files import write_clouds

    kind = check_choice(format, "--format", CLOUD_FORMATS)
    designs = collect_designs([target], notes=output.remark)
    if len(designs) > 1:
        names = ", ".join(str(design.path) for design in designs)
        raise ConfigError(f"{target} has {len(designs)} designs", where="RUN|DESIGN", allowed=f"one of {names}")
    announce([out], output)
    check_outputs({"--out": out}, [scene] if scene else [], () if kind == "mcap" else ("--out",))
    seen = designs[0].seen(scene, choices, notes=output.remark)
    with phase("writing"):
        notes = write_clouds(seen, out, kind)
    for note in notes:
        output.remark(note)
    if not any(one.returned.any() for each in seen for one in each.returns):
        output.remark("no ray returns: check that the scene stands where sensors look, in metres (--scale)")
    counts = [sum(int(one.returned.sum()) for one in each.returns) for each in seen]
    document = {
        "design": str(designs[0].path),
        "out": str(out),
        "format": kind,
        "scenes": [
            {"name": each.scene.name, "frames": len(each.returns), "returns": count, "effects": list(each.effects)}
            for each, count in zip(seen, counts, strict=True)
        ],
    }

    def show(rich: RichConsole) -> None:
        frames = counted(sum(len(each.returns) for each in seen), "frame")
        rich.print(f"wrote {out} ({counted(len(seen), 'scene')}, {frames}, {sum(counts)} returns)", soft_wrap=True)

    output.result(document, show, files={"wrote": out} if output.quiet else None, says_time=True)
