"""A robot arm read from MJCF: a chain of seven hinges in MuJoCo, with a tool that holds a ball."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidardesign import DataError, mujoco_models
from lidardesign_tasks.robot.targets import without_notes

if TYPE_CHECKING:
    import mujoco

VISUAL_GROUP = 2  # MuJoCo Menagerie's convention: visual geoms in group 2, collision geoms in group 3
GROUPS = 6  # of MuJoCo
BALL, TOOL = "lidardesign_ball", "lidardesign_tool"
JOINTS = 7
CHAIN = f"a chain of {JOINTS} hinge joints and no others"
CHAIN_HINT = "take the joints of a gripper out of the model: the task brings its own tool"
BALL_RADIUS_M = 0.02
TOOL_RADIUS_M = 0.015
TOOL_MASS_KG = 0.1
FLANGE_SITE = "attachment_site"  # MuJoCo Menagerie's name of the place where tools are mounted, its z axis outward
HOME_RAD = (0.0, np.pi / 4, 0.0, -np.pi / 2, 0.0, np.pi / 4, 0.0)


@dataclass(frozen=True, eq=False)
class Robot:
    """An arm of seven hinges with a tool along its flange's axis that holds a ball.

    Arguments:
        model: The MuJoCo model, with the tool, the ball and a site `BALL` at the ball's centre.
        links: Its visible pieces without the ball, the tool last.
        home_rad: A comfortable posture, shape (7,).
        notes: Repairs and omissions of reading, one line each.
    """

    model: mujoco.MjModel
    links: tuple[mujoco_models.ModelGeom, ...]
    home_rad: np.ndarray
    notes: tuple[str, ...]


def load_robot(path: Path | None, tool_m: float) -> Robot:
    """Read the arm of an MJCF file, or the embedded one, once per process while its files stay the same.

    Arguments:
        path: The file; None takes the embedded arm of primitive links.
        tool_m: Distance from the flange to the ball's centre [m].

    Raises:
        DataError: The file cannot be used: missing, no MJCF, files outside its folder, no chain of 7 hinges.
        ConfigError: MuJoCo is not installed.
    """
    if path is not None:
        return _read_once(path, mujoco_models.model_files(path), tool_m)
    with as_file(files("lidardesign_tasks") / "data" / "iiwa14.xml") as embedded:
        return _read_once(embedded, (), tool_m)


@lru_cache(maxsize=4)
def _read_once(path: Path, states: tuple[mujoco_models.FileState, ...], tool_m: float) -> Robot:
    """Read an arm; `states` of its files are part of the cache key, so that a changed model is read again."""
    model, warnings = mujoco_models.load_model(path, edit=lambda spec: _add_tool(_flange(spec, path), tool_m))
    _check_chain(model, path)
    links, notes = seen_links(model, path)
    return Robot(model, links, _home(model), (*warnings, *notes))


def seen_links(model: mujoco.MjModel, path: Path) -> tuple[tuple[mujoco_models.ModelGeom, ...], tuple[str, ...]]:
    """Visible pieces of an arm without its ball, the tool last, and notes on repairs and omissions.

    They are the geoms of the visual group, or all geoms where only tool and ball are in it.

    Raises:
        DataError: The arm has no visible shapes.
    """
    visual = int((model.geom_group == VISUAL_GROUP).sum()) > len((BALL, TOOL))
    pieces, notes = mujoco_models.visible_geoms(model, groups=(VISUAL_GROUP,) if visual else range(GROUPS))
    own = [piece for piece in pieces if piece.body and piece.geom_name not in (BALL, TOOL)]
    if not own:
        raise DataError("the arm has no visible shapes", where=str(path), allowed="geoms of group 2 on its links")
    several = Counter(piece.body for piece in own)
    links = [piece if several[piece.body] > 1 else replace(piece, name=piece.body_name) for piece in own]
    links += [replace(piece, name="tool") for piece in pieces if piece.geom_name == TOOL]
    in_world = sum(1 for piece in pieces if not piece.body)
    left_out = [f"shapes that stand in the world, not on the arm, are left out: {in_world}"] if in_world else []
    return tuple(map(without_notes, links)), tuple(f"{path.name}: {note}" for note in (*left_out, *notes))


def _flange(spec: Any, path: Path) -> Any:
    """The body of the last joint, in a specification that is not compiled yet."""
    joints = list(spec.joints)
    if len(joints) != JOINTS:
        raise DataError(f"has {len(joints)} joints", where=str(path), allowed=CHAIN, hint=CHAIN_HINT)
    return joints[-1].parent


def _add_tool(flange: Any, tool_m: float) -> None:
    """Fix the tool and the ball to the flange: the site `FLANGE_SITE` of the last link, or the link's frame."""
    mujoco = mujoco_models.import_mujoco()
    site = next((site for site in flange.sites if site.name == FLANGE_SITE), None)
    start = np.zeros(3) if site is None else np.array(site.pos)
    quaternion = np.array([1.0, 0.0, 0.0, 0.0]) if site is None else np.array(site.quat)
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion / np.linalg.norm(quaternion))
    axis = matrix.reshape(3, 3)[:, 2]
    centre = start + tool_m * axis
    end = start + (tool_m - BALL_RADIUS_M - TOOL_RADIUS_M) * axis  # its round end touches the ball
    flange.add_site(name=BALL, pos=centre, quat=quaternion)
    shared = {"group": VISUAL_GROUP, "mass": TOOL_MASS_KG}
    capsule, sphere = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_SPHERE
    ends = np.concatenate([start, end])
    flange.add_geom(name=TOOL, type=capsule, size=[TOOL_RADIUS_M, 0, 0], fromto=ends, **shared)
    flange.add_geom(name=BALL, type=sphere, size=[BALL_RADIUS_M, 0, 0], pos=centre, **shared)


def _check_chain(model: mujoco.MjModel, path: Path) -> None:
    hinges = int((model.jnt_type == int(mujoco_models.import_mujoco().mjtJoint.mjJNT_HINGE)).sum())
    if model.njnt != JOINTS or hinges != JOINTS:
        found = f"has {model.njnt} joints, {hinges} of them hinges"
        raise DataError(found, where=str(path), allowed=CHAIN, hint=CHAIN_HINT)
    carriers, body = set(), int(model.jnt_bodyid[-1])
    while body:
        carriers.add(body)
        body = int(model.body_parentid[body])
    if not set(model.jnt_bodyid.tolist()) <= carriers:
        raise DataError("its joints are not one chain", where=str(path), allowed=CHAIN)


def _home(model: mujoco.MjModel) -> np.ndarray:
    """The keyframe `home`, else the first one, else the posture of the embedded arm; within the joints' limits."""
    mujoco, home = mujoco_models.import_mujoco(), np.array(HOME_RAD)
    if model.nkey:
        key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
        home = np.array(model.key_qpos[max(key, 0)])
    low, high = np.where(model.jnt_limited[:, None], model.jnt_range, [-np.inf, np.inf]).T
    return np.clip(home, low, high)
