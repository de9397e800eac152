"""CPU against GPU: whether they give the same labels, and how long each takes.

    python benchmarks/bench_gpu.py [--device cuda] [--views 60] [--gaussians 1000000] [--data FOLDER]

Runs on a room of benchmarks/room.py, and on FOLDER/replica_apartment where that is there (default: $GSSEG_DATA, else
../shared/data). Both learn by `em` from the same masks. Without a GPU it says so in one line and ends with code 2.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

import numpy as np
from machine import asked_anew, once, parser_of, processor, timed, version
from room import build_room

from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View, spread
from gsseg_core.errors import SettingsError
from gsseg_core.learn.em.em_learner import EMLearner
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.warm_up import warm_up

SAMPLED = 5
"""Views over which the time of a product is averaged."""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    options = parser.parse_args(arguments)
    try:
        warm_up(options.device)
    except SettingsError as error:
        print(f"bench_gpu: {error}", file=sys.stderr)
        return 2
    warm_up("cpu")
    print(f"{options.device}: {_gpu(options.device)}, numba-cuda {version('numba-cuda')}, torch {version('torch')}")
    print(f"cpu: {processor()}\n")

    room = build_room(options.gaussians, num_views=options.views)
    codes = np.eye(10, dtype=np.float32)[room.truth]
    masks = [make_operator(room.scene, camera).render(codes).argmax(axis=2) for camera in room.cameras]
    views = [View.from_arrays(camera, mask) for camera, mask in zip(room.cameras, masks, strict=True)]
    _compare("room", room.scene, views, 10, options.device)

    folder = options.data / "replica_apartment"
    if not folder.is_dir():
        print(f"skipped: no {folder}; set GSSEG_DATA or --data to the folder that holds replica_apartment/")
        return 0
    data = Dataset(folder)
    views = spread([view for view in data.views("train") if view.has_mask], options.views)
    _compare("replica_apartment", GaussianScene.load(folder / "scene.ply"), views, data.num_classes, options.device)
    return 0


def _compare(name: str, scene: GaussianScene, views: list[View], num_classes: int, device: str) -> None:
    print(f"{name}: {len(scene):,} Gaussians, {len(views)} views, {num_classes} classes")
    print(f"| {'':24} | {'cpu':>10} | {device:>10} |\n| {'-' * 24} | ---------: | ---------: |")
    learners = {each: EMLearner(scene, num_classes, device=each) for each in ("cpu", device)}
    rows: dict[str, list[float]] = {}
    for each, learner in learners.items():
        for what, seconds in _products(scene, views, num_classes, each).items():
            rows.setdefault(f"{what}, ms", []).append(1000 * seconds)
        rows.setdefault("all masks observed, s", []).append(once(lambda use=learner: use.observe_all(views)))
        rows.setdefault("em, s", []).append(once(learner.fit))
    for what, values in rows.items():
        print(f"| {what:24} | " + " | ".join(f"{value:10.2f}" for value in values) + " |")
    cpu, gpu = learners.values()
    seen = cpu.observed_ & gpu.observed_
    same = (cpu.codes_.argmax(axis=1) == gpu.codes_.argmax(axis=1))[seen].mean()
    either = (cpu.observed_ | gpu.observed_).sum()
    print(f"same label: {100 * same:.3f} % of {seen.sum():,} observed by both, which are {either:,} by either")
    print(f"mean difference of a probability: {np.abs(cpu.codes_ - gpu.codes_)[seen].mean():.2e}\n")


def _products(scene: GaussianScene, views: list[View], num_classes: int, device: str) -> dict[str, float]:
    """Seconds of each product of one view, averaged over some. Results end on the CPU, so none is still pending."""
    codes = np.random.default_rng(0).random((len(scene), num_classes), np.float32)
    total = dict.fromkeys(("operator of a view", "render", "adjoint", "votes", "shares"), 0.0)
    chosen = spread(views, SAMPLED)
    for view in chosen:
        operator = make_operator(scene, view.camera, device)
        image, seen = operator.render(codes), operator.observe(view.read_labels())
        own = codes[seen.places] + np.float32(0.01)
        rest = np.ones(len(seen.classes), np.float32)
        jobs = (
            lambda view=view: make_operator(scene, view.camera, device),
            lambda use=operator: use.render(codes),
            lambda use=operator, image=image: use.adjoint(image),
            seen.votes,
            asked_anew(seen, own, rest),
        )
        for what, job in zip(total, jobs, strict=True):
            total[what] += float(np.median(timed(job, 3))) / len(chosen)
    return total


def _gpu(device: str) -> str:
    return str(importlib.import_module("torch").cuda.get_device_name(device))


if __name__ == "__main__":
    sys.exit(main())
