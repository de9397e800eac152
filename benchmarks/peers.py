"""What a user could take instead, each on the same scene and views as ours, in the same run."""

from __future__ import annotations

import sys
import sysconfig
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from children import ChildError, finish, last_words, run_child
from machine import REPOSITORY, timed
from report import Report
from workloads import MASKS, RoomSize, Sizes, make_room

from gsseg_core.raster.backends import make_operator
from gsseg_core.raster.cpu.projection import project
from gsseg_core.raster.cpu.tiling import assign

ENVIRONMENT = REPOSITORY / ".venv-peers"
BIASES = [-0.3, 0.0, 0.3]
PACKAGES = {
    "gsplat": ("gsplat", "nerfacc"),
    "litesplat": ("litesplat",),
    "taichi-splatting": ("taichi-nightly", "taichi-splatting"),
    "splatstream": ("splatstream",),
}
"""What the registry has that renders 3D Gaussians and does not say that it wants CUDA; with what each needs besides."""

LOOP = "against the loop in PyTorch"
OTHERS = "against the rasterisers of others"


def add_torch_loop(report: Report, sizes: Sizes, room: Path | None) -> None:
    """Measure the paper's loop, plainly in PyTorch, and our learners on the same small room."""
    answer = run_child("jobs.torch_loop", size=asdict(sizes.small), epochs=sizes.epochs)
    seconds, scores, steps = answer["seconds"], answer["mIoU"], answer["steps"]
    report.say(
        LOOP,
        f"{sizes.small}; {steps} steps of the loop ({sizes.epochs} epochs); mIoU of {sizes.small.tests} test views. "
        "Time to learn includes preparing the views.",
    )
    for name in seconds:
        report.add(LOOP, f"{name}: learn", "s", [seconds[name]])
        report.add(LOOP, f"{name}: mIoU", "", [scores[name]])
    report.add(LOOP, "em less PyTorch, mIoU", "", [scores["em"] - scores["PyTorch"]])
    report.add(LOOP, "PyTorch: one step", "s", [seconds["PyTorch"] / steps])
    for name in ("gradient", "em", "votes"):
        report.add(LOOP, f"PyTorch / {name}, time to learn", "x", [seconds["PyTorch"] / seconds[name]])
    if room is not None:
        step = run_child("jobs.torch_step", folder=str(room))
        report.add(LOOP, "workload (a), one step over one view: PyTorch", "s", [step["PyTorch"]])
        report.add(LOOP, "workload (a), EM's product for the same view", "s", [step["ours"]])
        report.add(LOOP, "workload (a), ratio of the two", "x", [step["PyTorch"] / step["ours"]])


def add_flashsplat(report: Report, folder: Path, name: str) -> None:
    """Compare FlashSplat's rule on our operator with our learners, on every set of masks that there is."""
    section = f"against FlashSplat's rule: {name}"
    report.say(
        section,
        "The largest of the normalised votes, a bias being added to the background's (Shen et al. 2024), from our "
        "operator. mIoU of test views, unrefined, against the true masks.",
    )
    for labels, title in MASKS.items():
        if (folder / labels).is_dir():
            answer = run_child("jobs.flashsplat", folder=str(folder), labels=labels, biases=BIASES)
            for learner, seconds in answer["seconds"].items():
                report.add(section, f"{title}, {learner}: learn", "s", [seconds])
                report.add(section, f"{title}, {learner}: mIoU", "", [answer["mIoU"][learner]])


def add_others(report: Report, sizes: Sizes, work: Path) -> None:
    """Try the rasterisers that can be installed; what cannot be run is said, with the reason that it gave."""
    report.say(
        OTHERS,
        f"What one camera of {sizes.tiny.width} x {sizes.tiny.height} sees of {sizes.tiny.gaussians:,} Gaussians, in "
        "three channels: a size that all of them can take. gsplat has a reference in PyTorch, which lists the pairs to "
        "blend with a CUDA kernel; LiteSplat evaluates every Gaussian in every pixel.",
    )
    ours = write_tiny(work / "tiny.npz", sizes.tiny, sizes.runs)
    for name, values in ours.items():
        report.add(OTHERS, f"ours: {name}", "s", values)
    if not sizes.others:
        report.say(OTHERS, f"Not tried in a {sizes.name} run: {', '.join(PACKAGES)}.")
        return
    for name, packages in PACKAGES.items():
        try:
            answer = try_other(name, packages, work / "tiny.npz", sizes.runs)
        except ChildError as error:
            report.say(OTHERS, f"{name}: cannot be installed or run here ({error}).")
            continue
        for stage in ("project", "bin", "render"):
            if stage in answer:
                values, mine = answer[stage], float(np.median(ours[stage]))
                report.add(OTHERS, f"{name} {answer['version']}: {stage}", "s", values)
                report.add(OTHERS, f"{name} / ours, {stage}", "x", [float(np.median(values)) / mine])
        if "failed" in answer:
            why = last_words(answer["failed"])
            report.say(OTHERS, f"{name} {answer['version']}: makes no picture on this machine ({why}).")


def write_tiny(path: Path, size: RoomSize, runs: int) -> dict[str, list[float]]:
    """Write what one camera sees of a small room, and time our own stages on it."""
    room = make_room(size)
    scene, camera = room.scene, room.cameras[0]
    scene = scene.subset(np.sort(make_operator(scene, camera).ids))
    colors = scene.colors(camera.center)
    np.savez(
        path,
        means=scene.means,
        quats=scene.quats,
        scales=scene.scales,
        opacities=scene.opacities,
        colors=colors,
        viewmat=camera.world_to_camera.astype(np.float32),
        K=camera.K.astype(np.float32),
        size=np.array([camera.width, camera.height]),
    )
    projected = project(scene, camera)
    return {
        "project": timed(lambda: project(scene, camera), runs),
        "bin": timed(lambda: assign(projected, camera.width, camera.height), runs),
        "render": timed(lambda: make_operator(scene, camera).render(colors), runs),
    }


def try_other(name: str, packages: tuple[str, ...], scene: Path, runs: int) -> dict[str, Any]:
    """Install one of them into an environment apart, which also sees the libraries of this one, and run it."""
    python = ENVIRONMENT / "bin" / "python"
    if not python.exists():
        finish([sys.executable, "-m", "venv", str(ENVIRONMENT)])
        inner = finish([str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]).strip()
        (Path(inner) / "ours.pth").write_text(sysconfig.get_path("purelib") + "\n")
    finish([str(python), "-m", "pip", "install", "--quiet", *packages], 300.0)
    if name in ("gsplat", "litesplat"):
        return run_child(f"others.{name}", python=python, patience=300.0, scene=str(scene), runs=runs)
    needs = {"taichi-splatting": "CUDA", "splatstream": "Vulkan"}[name]
    return run_child(
        "others.importable", python=python, module=name.replace("-", "_"), package=name, needs=needs, patience=300.0
    )
