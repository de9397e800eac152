"""Readers of scene files that are not by those who wrote them: what they say a file holds, in the axes of the scene."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from patience import PATIENCE

from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.spherical_harmonics import basis

SPLAT_TRANSFORM = "@playcanvas/splat-transform@2.7.1"


class Read(NamedTuple):
    """Activated values of N Gaussians: those of `GaussianScene`, harmonics (N, (d + 1)^2, 3)."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray

    @classmethod
    def of(cls, scene: GaussianScene) -> Read:
        return cls(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh)

    def turned(self, rotation: np.ndarray) -> Read:
        """Turn by half a turn, whose matrix is diagonal; the harmonics by what they are, functions of a direction."""
        degree = round(self.sh.shape[1] ** 0.5) - 1
        directions = np.random.default_rng(0).normal(size=(64, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        seen = np.einsum("db,nbc->dnc", basis(directions @ rotation, degree), self.sh)
        sh, *_ = np.linalg.lstsq(basis(directions, degree), seen.reshape(64, -1), rcond=None)
        quats = self.quats * np.concatenate([[1], np.diag(rotation)])
        return self._replace(
            means=self.means @ rotation.T, quats=quats, sh=sh.reshape(-1, len(self.sh), 3).swapaxes(0, 1)
        )


ABOUT_X, ABOUT_Z = np.diag([1.0, -1, -1]), np.diag([-1.0, -1, 1])


def by_gsply(path: Path) -> Read:
    """Read a PLY; it turns nothing."""
    import gsply

    found = gsply.plyread(path)
    opacities = 1 / (1 + np.exp(-found.opacities.reshape(-1)))
    sh = np.concatenate([found.sh0[:, None], found.shN], axis=1)
    quats = found.quats / np.linalg.norm(found.quats, axis=1, keepdims=True)
    return Read(found.means, quats, np.exp(found.scales), opacities, sh)


def by_gaussforge(path: Path) -> Read:
    """Read whatever gaussforge does, by way of a PLY; it turns nothing."""
    import gaussforge

    kind = "compressed.ply" if path.name.endswith(".compressed.ply") else path.suffix[1:]
    made = gaussforge.GaussForge().convert(path.read_bytes(), kind, "ply")
    assert "error" not in made, made
    ply = path.with_name("by_gaussforge.ply")
    ply.write_bytes(made["data"])
    return Read.of(GaussianScene.load(ply))


def by_splat_transform(path: Path) -> Read:
    """Read whatever PlayCanvas's converter does, by way of a PLY; it turns what it reads to the axes of PLYs."""
    ply = path.with_name("by_splat_transform.ply")
    command = [splat_transform(), "-q", "-w", str(path), str(ply)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    return Read.of(GaussianScene.load(ply))


def splat_transform() -> str:
    """Find PlayCanvas's converter, or install it where npm and a network are; skip the test elsewhere."""
    found = os.environ.get("GSSEG_SPLAT_TRANSFORM") or shutil.which("splat-transform")
    if found:
        return found
    npm = shutil.which("npm")
    folder = Path(__file__).parents[2] / ".pytest_cache" / "splat-transform"
    program = folder / "node_modules/.bin/splat-transform"
    if npm and not program.exists():
        options = ["--no-audit", "--no-fund", "--prefer-offline", "--prefix", str(folder)]
        with suppress(subprocess.TimeoutExpired):
            subprocess.run([npm, "install", *options, SPLAT_TRANSFORM], capture_output=True, timeout=120)
    if not program.exists():
        pytest.skip("needs npm and a network, or splat-transform")
    return str(program)


def by_pygltflib(path: Path) -> Read:
    """Read a GLB with KHR_gaussian_splatting, whose y is up."""
    import pygltflib

    gltf = pygltflib.GLTF2.load_binary(str(path))
    (primitive,) = gltf.meshes[0].primitives
    blob = gltf.binary_blob()
    components = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}

    def values(name: str) -> np.ndarray:
        accessor = gltf.accessors[json.loads(primitive.attributes.to_json())[name]]
        view = gltf.bufferViews[accessor.bufferView]
        dtype = {5126: np.dtype("<f4"), 5121: np.dtype("u1")}[accessor.componentType]
        count = accessor.count * components[accessor.type]
        return np.frombuffer(blob, dtype, count, view.byteOffset).reshape(accessor.count, -1)

    names = [n for n in json.loads(primitive.attributes.to_json()) if ":SH_" in n]
    sh = np.stack([values(name) for name in names], axis=1)
    prefix = "KHR_gaussian_splatting:"
    quats = values(f"{prefix}ROTATION")[:, [3, 0, 1, 2]]
    opacities = values(f"{prefix}OPACITY")[:, 0]
    return Read(values("POSITION"), quats, values(f"{prefix}SCALE"), opacities, sh).turned(ABOUT_Z)


def by_usd(path: Path, prim: str = "/Scene/scene/splats") -> Read:
    """Read one prim of a USD stage; values are in the axes of the scene, and its root is turned."""
    from pxr import Usd, UsdVol

    stage = Usd.Stage.Open(str(path))
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath(prim))
    quats = np.array([[q.GetReal(), *q.GetImaginary()] for q in splats.GetOrientationsAttr().Get()])
    degree = splats.GetRadianceSphericalHarmonicsDegreeAttr().Get()
    sh = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    return Read(
        np.array(splats.GetPositionsAttr().Get()), quats, np.array(splats.GetScalesAttr().Get()),
        np.array(splats.GetOpacitiesAttr().Get()), sh.reshape(-1, (degree + 1) ** 2, 3),
    )  # fmt: skip
