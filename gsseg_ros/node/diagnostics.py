"""Reports the state of the node: counts, ages and a verdict on `/diagnostics`, and warnings in the log."""

from __future__ import annotations

import time
from collections import Counter

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from gsseg_core.learn.renamed_ids import renamed_note, renamed_report
from gsseg_core.live.results import SCENE_CHANGED
from gsseg_core.live.session import LiveSession
from gsseg_core.text import counted
from gsseg_ros.node.complaints import CLOCK, MISSING, NAMESAKES, PERIOD, TIME_JUMP, Complaints
from gsseg_ros.node.inputs import Inputs
from gsseg_ros.node.matched_subscription import LATCHED
from gsseg_ros.node.workspace import Workspace

WINDOW_SECONDS = 10.0
"""The verdict counts the refused masks of so many last seconds, by a clock that never stands still."""

WARN_SHARE, ERROR_COUNT = 0.1, 3
"""The verdict is WARN from this share of refused masks on, and ERROR if all were, and at least so many."""

_ACCEPTED = "accepted"

_HINTS = {
    "mask": "is the segmenter running, and is its topic remapped to this one (--ros-args -r mask:=...)?",
    "camera_info": "remap it to the rectified camera's camera_info (--ros-args -r camera_info:=...)",
    "pose": "expected geometry_msgs/PoseStamped of the camera's optical frame, at the stamps of the masks; "
    "other sources: parameter pose_source",
    "depth": "expected sensor_msgs/Image with depths of the camera's image (--ros-args -r depth:=...), or the "
    "parameter depth_gating to be false",
    "detections": "is the detector running, and is this the parameter detections_topic that was meant?",
    "odometry": "expected nav_msgs/Odometry; is it remapped (--ros-args -r odometry:=...)?",
}


def rejections(inputs: Inputs) -> dict[str, int]:
    """Count the masks that did not become views, by reason, from arrival to fusion."""
    return dict(sorted((Counter(inputs.dropped) + Counter(inputs.rejected)).items()))


def missing_inputs(inputs: Inputs) -> dict[str, str]:
    """Explain what to check for each input that was silent for five seconds; by its role, such as "mask"."""
    now = time.monotonic()
    complaints: dict[str, str] = {}
    for topic, role in sorted(inputs.roles.items(), key=lambda item: item[1] != "mask"):  # The mask first.
        count, last = inputs.arrivals[topic]
        silence, this_side = now - last, inputs.policies.get(topic, "not subscribed")
        if silence < PERIOD or (count and this_side.endswith(LATCHED)):
            continue
        publishers = inputs.publishers_of(topic)
        found = counted(publishers, "publisher")
        if publishers and not count:
            hint = (
                f"it has {found}: do their QoS and type match (this side is {this_side}; ros2 topic info -v {topic}), "
                "and do they publish?"
            )
        elif publishers:
            hint = f"{count} came before, and it still has {found}"
        else:
            hint = f"nobody publishes it: {_HINTS[role]}"
        line = f"no data on {topic} for {silence:.0f} s; {hint}"
        complaints[role] = f"{complaints[role]}; {line}" if role in complaints else line  # Of several cameras.
    return complaints


def namesakes(inputs: Inputs) -> str:
    """Say that other nodes have this node's name, and what to do; empty if none has."""
    if (others := inputs.namesakes) < 1:
        return ""
    found = counted(others, "other node has", "other nodes have")
    return (
        f"{found} this node's name: a request is worked on by each, and answered by the first; expected names of their "
        "own (--ros-args -r __node:=... or __ns:=...); one that was killed is forgotten within a minute"
    )


def renamed_ids_of(session: LiveSession) -> str:
    """Say which ids name one object, as far as what was learnt tells, and what to do; empty if none does."""
    learnt = session.learnt  # Once: it may be forgotten meanwhile.
    pairs = [] if learnt is None else renamed_report(learnt.renamed, session.class_names)
    return renamed_note(pairs, "The parameter ids set to per-view", "label_map")


def why_dropped(inputs: Inputs, reason: str) -> str:
    """Explain why masks are dropped before they are fused, and what to check; empty for other reasons."""
    came = "with their stamp came, neither in time nor late"
    return {
        "no_pose": f"no pose {came}{_pose_problem(inputs)}; expected mask and pose to carry the stamp of the same "
        "image, from the same clock (use_sim_time?), or the parameter pose_tolerance",
        "no_camera_info": f"no camera_info {came}{_frame_problem(inputs)}; expected mask and camera_info to carry the "
        "stamp of the same image, from the same clock (use_sim_time?)",
        "no_depth": f"no depth image {came}; expected depth with the stamp of the mask's image, or the parameter "
        "depth_gating to be false",
        "repeated_stamp": "a mask with their stamp and frame_id came before; expected every image once: is the "
        "segmenter, or a bag, running twice?",
        "several_cameras": "masks of several cameras (frame_id) carry one stamp, and their poses do not say whose they "
        "are; expected the parameter pose_source to be tf, or cameras to name them, each with topics of its own",
        "negative_stamp": f"their stamp is below 0{_negative_stamps(inputs)}; expected the time at which the image "
        "was taken, by the clock of the poses",
        "lost": f"they were lost on the way to this node{_unreliable(inputs)}; expected a publisher that is reliable "
        "and keeps as many as come while this node is busy, or smaller masks",
        "time_jump": "they are from before time was set back; expected so only for a moment, then check the clocks",
        "queue_full": "they come faster than they are fused; expected a lower rate or smaller masks (the parameter "
        "queue_size says how many may wait)",
    }.get(reason, "")


def complain(complaints: Complaints, inputs: Inputs | None, clock_problem: str) -> None:
    """Warn in the log of missing inputs, lost masks and other nodes of this name; call it once a second."""
    complaints.remind(CLOCK, clock_problem)
    if inputs is not None:
        for role, line in missing_inputs(inputs).items():
            complaints.remind(MISSING[role], line)
        complaints.remind(NAMESAKES, namesakes(inputs))
        _complain_of_losses(complaints, inputs)
    complaints.flush()


def _complain_of_losses(complaints: Complaints, inputs: Inputs) -> None:
    pairing = max((camera.pairing for camera in inputs.cameras.values()), key=lambda p: p.time_jumps)
    logged, jumps = inputs.logged, pairing.time_jumps
    if jumps > logged[TIME_JUMP] and complaints.due(TIME_JUMP):
        before, after = (stamp / 1e9 for stamp in pairing.last_jump)
        times = f" {jumps - logged[TIME_JUMP]} times, the last time" * (jumps - logged[TIME_JUMP] > 1)
        complaints.add(
            TIME_JUMP,
            f"time was set back{times} from {before:.3f} s to {after:.3f} s: poses, camera_infos and masks of before "
            "are forgotten (did a bag begin again, or a simulator?)",
        )
        logged[TIME_JUMP] = jumps
    for reason, count in rejections(inputs).items():
        why, more = why_dropped(inputs, reason), count - logged[reason]
        if why and more and complaints.due(reason):
            complaints.add(reason, f"{counted(more, 'mask was', 'masks were')} dropped because {why}")
            logged[reason] = count


def _pose_problem(inputs: Inputs) -> str:
    refused_at, refusal = inputs.last_refusal
    if time.monotonic() - refused_at < WINDOW_SECONDS:
        return f" ({refusal})"
    return f" ({inputs.tf.problem})" if inputs.tf is not None and inputs.tf.problem else ""


def _unreliable(inputs: Inputs) -> str:
    found = ", ".join(f"{topic}: {inputs.policies[topic]}" for topic, count in inputs.lost.items() if count)
    return f" ({found})" * bool(found)


def _negative_stamps(inputs: Inputs) -> str:
    stamps = {camera.topic("mask"): camera.pairing.negative_stamp for camera in inputs.cameras.values()}
    found = ", ".join(f"{stamp / 1e9:.3f} s on {topic}" for topic, stamp in stamps.items() if stamp)
    return f" ({found})" * bool(found)


def _frame_problem(inputs: Inputs) -> str:
    for camera in inputs.cameras.values():
        mask, infos = camera.pairing.unmatched_frame, camera.pairing.camera_frames
        if mask is not None and infos and not {mask, ""} & set(infos):
            known = ", ".join(map(repr, infos))
            return f" (masks have the frame_id '{mask}', camera_infos have {known}: expected the same)"
    return ""


def diagnostic_array(
    name: str, workspace: Workspace, inputs: Inputs | None, stamp: object, clock_problem: str = ""
) -> DiagnosticArray:
    """Make the message for `/diagnostics`.

    Its level is OK while masks are fused; WARN if something is amiss that may cost views: not active, no scene, no
    clock, silent inputs, refused poses or scene changes, another node of this name, a tenth or more of the masks of the
    last ten seconds refused; also if ids name one object; ERROR if all of these masks were refused, three at least.
    """
    recent = _recent(inputs) if inputs is not None else Counter[str]()
    level, message = _verdict(workspace, inputs, recent, clock_problem)
    status = DiagnosticStatus(level=level, name=name, message=message, hardware_id="gsseg")
    values: dict[str, object] = {"active": workspace.active, "last job": workspace.last_job}
    values.update(_scene_values(workspace))
    if inputs is not None:
        values.update(_input_values(inputs))
        refused = recent.total() - recent[_ACCEPTED]
        values[f"refused in the last {WINDOW_SECONDS:.0f} s"] = f"{refused} of {recent.total()}"
    status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    array = DiagnosticArray(status=[status])
    array.header.stamp = stamp
    return array


def _recent(inputs: Inputs) -> Counter[str]:
    """Masks of the last ten seconds that were fused, and that were refused, by reason."""
    now, counted = time.monotonic(), inputs.counted
    counts = Counter(rejections(inputs))
    del counts[SCENE_CHANGED]  # Nothing was wrong with them.
    counts[_ACCEPTED] = inputs.accepted
    counted.append((now, counts))
    while len(counted) > 2 and counted[1][0] <= now - WINDOW_SECONDS:
        counted.popleft()
    return counts - counted[0][1]


def _verdict(
    workspace: Workspace, inputs: Inputs | None, recent: Counter[str], clock_problem: str
) -> tuple[bytes, str]:
    if clock_problem:
        return DiagnosticStatus.WARN, clock_problem
    if inputs is None or not workspace.active:
        return DiagnosticStatus.WARN, "not active"
    if (session := workspace.loaded) is None:
        return DiagnosticStatus.WARN, "no scene is loaded"
    refused = recent.total() - recent[_ACCEPTED]
    if refused and refused >= WARN_SHARE * recent.total():
        all_refused = refused == recent.total() >= ERROR_COUNT
        return DiagnosticStatus.ERROR if all_refused else DiagnosticStatus.WARN, _refusals(inputs, recent)
    for refused_at, why in (inputs.last_refusal, workspace.refused_change):
        if time.monotonic() - refused_at < PERIOD:
            return DiagnosticStatus.WARN, why
    complaints = missing_inputs(inputs)
    if complaints:
        return DiagnosticStatus.WARN, next(iter(complaints.values()))
    if others := namesakes(inputs):
        return DiagnosticStatus.WARN, others
    if doubt := workspace.frames.problem(session) or renamed_ids_of(session):
        return DiagnosticStatus.WARN, doubt
    return DiagnosticStatus.OK, "fusing"


def _refusals(inputs: Inputs, recent: Counter[str]) -> str:
    reasons = Counter({reason: count for reason, count in recent.items() if reason != _ACCEPTED})
    (reason, count), *_ = reasons.most_common(1)
    why = why_dropped(inputs, reason) or inputs.explained.get(reason, "")
    return (
        f"{reasons.total()} of {recent.total()} masks of the last {WINDOW_SECONDS:.0f} s were refused, {count} of them "
        f"as {reason}: {why}"
    )


def _scene_values(workspace: Workspace) -> dict[str, object]:
    if (session := workspace.loaded) is None:
        return {"scene": "none"}
    learnt = session.learnt
    return {
        "scene": f"{session.scene.path}",
        "gaussians": len(session.scene),
        "classes": len(session.class_names),
        "codes": "none" if not session.has_codes else "votes" if learnt is None else learnt.learner,
        "changes of the class probabilities": session.version,
        "views fused": session.num_fused,
        "views kept": session.num_views,
        **{f"scene changes: {what}": count for what, count in sorted(workspace.changes.items())},
    }


def _input_values(inputs: Inputs) -> dict[str, object]:
    now = time.monotonic()
    values: dict[str, object] = {}
    for topic, (count, last) in list(inputs.arrivals.items()):  # Another thread may subscribe to detections.
        values[f"{topic} received"] = count
        values[f"{topic} age [s]"] = f"{now - last:.1f}" if count else "never"
    values.update({f"{topic} lost on the way": count for topic, count in inputs.lost.items()})
    values["views accepted"] = inputs.accepted
    values.update(
        {f"views accepted of {camera.name}": camera.accepted for camera in inputs.cameras.values() if camera.name}
    )
    if inputs.gated:
        values["views gated by depth"] = inputs.gated["views"]
        values["pixels with a measured depth"] = inputs.gated["measured"]
        values["pixels unknown by depth"] = inputs.gated["contradicted"]
    for reason, count in rejections(inputs).items():
        values[f"rejected {reason}"] = count
    pairings = [camera.pairing for camera in inputs.cameras.values()]
    values["masks waiting for pose or camera_info"] = sum(pairing.waiting for pairing in pairings)
    values["bytes of these masks"] = sum(pairing.waiting_bytes for pairing in pairings)
    values["masks waiting to be fused"] = inputs.worker.waiting
    values["queue drops"] = inputs.worker.dropped
    values["poses refused"] = inputs.refused_poses
    values["out of order"] = sum(pairing.out_of_order for pairing in pairings)
    values["time jumps"] = max(pairing.time_jumps for pairing in pairings)
    return values
