"""Arms written as MJCF."""

from __future__ import annotations

TOOL_M = 0.15

PIECE = '<body pos="0 0 .18"><joint axis="{axis}"/><geom type="capsule" size=".03" fromto="0 0 0 0 0 .18"/>'


def mjcf(links=7, *, inside="", world="", piece=PIECE):
    """A chain of hinges whose axes alternate."""
    chain = "".join(piece.format(axis="0 0 1" if link % 2 == 0 else "0 1 0") for link in range(links))
    return f"<mujoco>{inside}<worldbody>{world}{chain}{'</body>' * links}</worldbody></mujoco>"


def written(folder, text, name="arm.xml"):
    path = folder / name
    path.write_text(text)
    return path
