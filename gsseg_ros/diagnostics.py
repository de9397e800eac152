"""How the node is: counts and ages for `/diagnostics`, and the reason why nothing arrives for the log."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from gsseg_ros.inputs import COMPLAIN_PERIOD, Inputs
from gsseg_ros.workspace import Workspace

_HINTS = {
    "mask": "is the segmenter running, and is its topic remapped to this one (--ros-args -r mask:=...)?",
    "camera_info": "remap it to the rectified camera's camera_info (--ros-args -r camera_info:=...)",
    "pose": "expected geometry_msgs/PoseStamped of the camera's optical frame, at the stamps of the masks; "
    "other sources: parameter pose_source",
    "odometry": "expected nav_msgs/Odometry; is it remapped (--ros-args -r odometry:=...)?",
}


def rejections(inputs: Inputs) -> dict[str, int]:
    """Masks that did not become views, by reason, from arrival to fusion."""
    counts = Counter(inputs.pairing.dropped) + Counter(inputs.rejected)
    if inputs.worker.dropped:
        counts["queue_full"] += inputs.worker.dropped
    return dict(sorted(counts.items()))


def missing_inputs(inputs: Inputs) -> list[str]:
    """Say of each input from which nothing came for five seconds what to check."""
    now, complaints = time.monotonic(), []
    for topic, (count, last) in inputs.arrivals.items():
        silence = now - last
        if silence < COMPLAIN_PERIOD:
            continue
        publishers = inputs.publishers_of(topic)
        many = f"{publishers} publisher{'s' * (publishers > 1)}"
        if publishers and not count:
            hint = (
                f"it has {many}: do their QoS and type match (this side is {inputs.policies[topic]}; "
                f"ros2 topic info -v {topic}), and do they publish?"
            )
        elif publishers:
            hint = f"{count} came before, and it still has {many}"
        else:
            hint = f"nobody publishes it: {_HINTS.get(topic.rsplit('/', 1)[-1], 'check the remapping')}"
        complaints.append(f"no data on {topic} for {silence:.0f} s; {hint}")
    return complaints


def unpaired(inputs: Inputs, before: Mapping[str, int]) -> list[str]:
    """Say why masks were dropped since `before` for want of a pose or camera_info at their stamp."""
    dropped, complaints = inputs.pairing.dropped, []
    tf_problem = inputs.tf.problem if inputs.tf is not None else ""
    for reason, what in (("no_pose", "pose"), ("no_camera_info", "camera_info")):
        count = dropped[reason] - before.get(reason, 0)
        if count > 0:
            why = f": {tf_problem}" if reason == "no_pose" and tf_problem else ""
            complaints.append(
                f"{count} masks were dropped because no {what} with their stamp came within a second{why}; expected "
                f"mask and {what} to carry the stamp of the same image, from the same clock (use_sim_time?)"
            )
    return complaints


def diagnostic_array(name: str, workspace: Workspace, inputs: Inputs | None, stamp: object) -> DiagnosticArray:
    """Put all that an operator wants to know into one message."""
    level, message = _verdict(workspace, inputs)
    status = DiagnosticStatus(level=level, name=name, message=message, hardware_id="gsseg")
    values: dict[str, object] = {"active": workspace.active, "last job": workspace.last_job}
    values.update(_scene_values(workspace))
    if inputs is not None:
        values.update(_input_values(inputs))
    status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    array = DiagnosticArray(status=[status])
    array.header.stamp = stamp
    return array


def _verdict(workspace: Workspace, inputs: Inputs | None) -> tuple[bytes, str]:
    if inputs is None or not workspace.active:
        return DiagnosticStatus.WARN, "not active"
    if not workspace.has_scene:
        return DiagnosticStatus.WARN, "no scene is loaded"
    refused_at, why = inputs.last_refusal
    if time.monotonic() - refused_at < COMPLAIN_PERIOD:
        return DiagnosticStatus.WARN, why
    complaints = missing_inputs(inputs)
    if complaints:
        return DiagnosticStatus.WARN, complaints[0]
    return DiagnosticStatus.OK, "fusing"


def _scene_values(workspace: Workspace) -> dict[str, object]:
    if not workspace.has_scene:
        return {"scene": "none"}
    session = workspace.session
    learnt = session.learnt
    return {
        "scene": f"{session.scene.path}",
        "gaussians": len(session.scene),
        "classes": len(session.class_names),
        "codes": "none" if not session.has_codes else "votes" if learnt is None else learnt.learner,
        "views fused": session.num_fused,
        "views kept": session.num_views,
    }


def _input_values(inputs: Inputs) -> dict[str, object]:
    now = time.monotonic()
    values: dict[str, object] = {}
    for topic, (count, last) in inputs.arrivals.items():
        values[f"{topic} received"] = count
        values[f"{topic} age [s]"] = f"{now - last:.1f}" if count else "never"
    values["views accepted"] = inputs.accepted
    for reason, count in rejections(inputs).items():
        values[f"rejected {reason}"] = count
    values["masks waiting for pose or camera_info"] = inputs.pairing.waiting
    values["masks waiting to be fused"] = inputs.worker.waiting
    values["queue drops"] = inputs.worker.dropped
    values["poses refused"] = inputs.refused_poses
    values["out of order"] = inputs.pairing.out_of_order
    values["time jumps"] = inputs.pairing.time_jumps
    return values
