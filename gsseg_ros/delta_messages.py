"""Changes of a scene as messages: SceneDelta from and to what the core takes."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from gsseg_msgs.msg import GroupMove as GroupMoveMessage
from gsseg_msgs.msg import SceneDelta as SceneDeltaMessage

from gsseg_core.errors import GssegError
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.scene_delta import MAX_ID, GroupMove, SceneDelta
from gsseg_core.scene.similarity import Similarity
from gsseg_ros.conversions import array_from_point, transform_of
from gsseg_ros.errors import InvalidRequestError
from gsseg_ros.frames import rotation_from_quaternion

_SIZES = {"means": 3, "quats": 4, "scales": 3, "opacities": 1}


def delta_from_message(message: SceneDeltaMessage) -> SceneDelta:
    """Read a change of a scene.

    Raises `InvalidRequestError`: its arrays do not fit each other, or hold impossible values.
    """
    try:
        removed, ids, groups = (_numbers(message, name) for name in ("removed", "added_ids", "added_groups"))
        if len(groups) <= 1:
            groups = np.full(len(ids), groups[0] if len(groups) else 0, np.int64)
        moves = tuple(_move(move) for move in message.moves)
        return SceneDelta(message.revision or None, removed, _added(message, len(ids)), ids, groups, moves)
    except GssegError as error:
        raise InvalidRequestError(str(error)) from error


def message_from_delta(delta: SceneDelta) -> SceneDeltaMessage:
    """Write a change of a scene; its header is left to the caller."""
    message = SceneDeltaMessage(
        revision=int(delta.revision or 0),
        moves=[
            GroupMoveMessage(
                group=int(move.group),
                motion=transform_of(move.motion.rotation, move.motion.translation),
                scale=move.motion.scale,
                views=list(move.views),
            )
            for move in delta.moves
        ],
    )
    for name in ("removed", "added_ids", "added_groups"):
        getattr(message, name).frombytes(getattr(delta, name).astype(np.uint64).tobytes())
    if delta.added is not None:
        for name in (*_SIZES, "sh"):
            getattr(message, name).frombytes(getattr(delta.added, name).astype(np.float32).tobytes())
    return message


def _numbers(message: SceneDeltaMessage, name: str) -> npt.NDArray[np.int64]:
    numbers = np.array(getattr(message, name), np.uint64)
    if numbers.max(initial=0) > MAX_ID:
        raise InvalidRequestError(f"scene delta: {name} hold {numbers.max()}; expected numbers of at most {MAX_ID}")
    return numbers.astype(np.int64)


def _added(message: SceneDeltaMessage, count: int) -> GaussianScene | None:
    arrays: list[npt.NDArray[np.float32]] = []
    for name, size in _SIZES.items():
        given = np.array(getattr(message, name), np.float32)
        if len(given) != count * size:
            raise InvalidRequestError(
                f"scene delta: {name} are {len(given)} numbers; expected {count * size}, {size} for each of added_ids"
            )
        arrays.append(given.reshape(count, size) if size > 1 else given)
    sh = np.array(message.sh, np.float32)
    if len(sh) not in [3 * bands * count for bands in (1, 4, 9, 16)]:
        raise InvalidRequestError(
            f"scene delta: sh are {len(sh)} numbers; expected 3, 12, 27 or 48 for each of {count} added_ids"
        )
    means, quats, scales, opacities = arrays
    return GaussianScene.from_arrays(means, quats, scales, opacities, sh.reshape(count, -1, 3)) if count else None


def _move(message: GroupMoveMessage) -> GroupMove:
    turn = message.motion.rotation
    quaternion = turn.x, turn.y, turn.z, turn.w
    length = math.hypot(*quaternion)
    if not 0 < length < np.inf or message.group > MAX_ID:
        raise InvalidRequestError(
            f"scene delta: group {message.group} moves by a quaternion of length {length:g}; expected one of length 1, "
            f"and a group of at most {MAX_ID}"
        )
    rotation, translation = rotation_from_quaternion(*quaternion), array_from_point(message.motion.translation)
    motion = Similarity(message.scale or 1.0, rotation, translation)
    return GroupMove(message.group, motion, tuple(message.views))
