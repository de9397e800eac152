"""OpenUSD: a ParticleField3DGaussianSplat for each object under one scene, with its class and a mesh to collide with.

Values are activated float32, in the axes of the scene. The stage's y axis is up, so its root is turned by half a turn.

    /Scene                          Xform, the default prim
    /Scene/class_1_chair            Xform, to move the object by
    /Scene/class_1_chair/splats     ParticleField3DGaussianSplat, with its class as a semantic label
    /Scene/class_1_chair/collision  Mesh that is not drawn, with the collision schemas of UsdPhysics
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdSemantics, UsdVol, Vt

from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.quaternions import covariances
from gsseg_core.scene.scene_writers import SceneObject
from gsseg_core.scene.triangle_mesh import TriangleMesh
from gsseg_core.text import one_line, printable

TAXONOMY = "class"  # of the semantic labels
_REACH = 3.0  # standard deviations of a Gaussian that count for the extent of an object


def write_usd(path: Path, objects: Sequence[SceneObject], run: str | None) -> None:
    """Write objects as a USD stage; the id of a run is in the layer's `customLayerData`."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/Scene")
    root.AddRotateZOp().Set(180.0)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.assembly)
    stage.SetDefaultPrim(root.GetPrim())
    if run is not None:
        stage.GetRootLayer().customLayerData = {"gsseg_run": run}
    for one in objects:
        place = root.GetPath().AppendChild(_identifier(one))
        parent = UsdGeom.Xform.Define(stage, place)
        Usd.ModelAPI(parent).SetKind(Kind.Tokens.component)
        splats = _define_splats(stage, place.AppendChild("splats"), one.scene)
        if one.label is not None:
            parent.GetPrim().SetDisplayName(printable(one.name))
            UsdSemantics.LabelsAPI.Apply(splats, TAXONOMY).CreateLabelsAttr([printable(one.name)])
        if one.collision is not None:
            _define_collision(stage, place.AppendChild("collision"), one.collision)
    try:
        stage.GetRootLayer().Export(str(path))
    except Tf.ErrorException as error:
        raise OSError(one_line(str(error.args[0].commentary))) from error


def _identifier(one: SceneObject) -> str:
    """Name of an object's prim; with the id of its class, as names may differ only in characters that are left out."""
    if one.label is None:
        return "scene"
    return f"class_{one.label}_{re.sub(r'[^0-9A-Za-z]+', '_', one.name)[:100]}".rstrip("_")


def _define_splats(stage: Usd.Stage, place: Sdf.Path, scene: GaussianScene) -> Usd.Prim:
    splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, place)
    splats.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(scene.means))
    # In memory, a quaternion of USD has its real part last.
    splats.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(np.ascontiguousarray(scene.quats[:, [1, 2, 3, 0]])))
    splats.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scene.scales))
    splats.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(scene.opacities))
    splats.CreateRadianceSphericalHarmonicsDegreeAttr(scene.sh_degree)
    splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(scene.sh.reshape(-1, 3)))
    spread = covariances(scene.quats, scene.scales)
    reach = _REACH * np.sqrt(np.diagonal(spread, axis1=1, axis2=2))  # (N, 3)
    splats.CreateExtentAttr(_extent((scene.means - reach).min(axis=0), (scene.means + reach).max(axis=0)))
    return splats.GetPrim()


def _define_collision(stage: Usd.Stage, place: Sdf.Path, collision: TriangleMesh) -> None:
    mesh = UsdGeom.Mesh.Define(stage, place)
    points, triangles, convex = collision
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(triangles), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(triangles.reshape(-1))))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreatePurposeAttr(UsdGeom.Tokens.guide)
    mesh.CreateExtentAttr(_extent(points.min(axis=0), points.max(axis=0)))
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    approximation = UsdPhysics.Tokens.convexHull if convex else UsdPhysics.Tokens.none
    UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr(approximation)


def _extent(low: np.ndarray, high: np.ndarray) -> list[Gf.Vec3f]:  # (3,), (3,)
    return [Gf.Vec3f(*low.tolist()), Gf.Vec3f(*high.tolist())]
