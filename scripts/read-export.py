#!/usr/bin/env python3
"""Reads a run's exports with other libraries and compares every number with model.ply, read by plyfile.

    python3 -m venv env && env/bin/pip install numpy plyfile pygltflib usd-core
    nightsplat export RUN --format glb && env/bin/python scripts/read-export.py RUN/model.glb
    nightsplat export RUN --format usda && env/bin/python scripts/read-export.py RUN/model.usda

model.ply lies beside the export, or is the second argument. glTF and USD have y up: positions, rotations and the
directions of SH are rotated by half a turn about x. Runs whose up direction is not -y need `--up none`.
"""

import pathlib
import sys

import numpy as np
from plyfile import PlyData

EXTENSION = "KHR_gaussian_splatting"


def read_glb(path):
    """The attributes of the one primitive, as the accessors describe them, by pygltflib."""
    from pygltflib import GLTF2

    gltf = GLTF2.load(str(path))
    assert EXTENSION in gltf.extensionsUsed
    (mesh,) = gltf.meshes
    (primitive,) = mesh.primitives
    assert primitive.mode == 0 and EXTENSION in primitive.extensions
    body, found = gltf.binary_blob(), {}
    for name, index in vars(primitive.attributes).items():
        if index is None:
            continue
        accessor = gltf.accessors[index]
        view = gltf.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        assert accessor.componentType == 5126 and not view.byteStride
        begin = (view.byteOffset or 0) + (accessor.byteOffset or 0)
        values = np.frombuffer(body, "<f4", accessor.count * width, begin).reshape(-1, width)
        found[name.removeprefix(EXTENSION + ":")] = values.astype(np.float64)
    degrees = sorted(name for name in found if name.startswith("SH_DEGREE_"))
    return {
        "positions": found["POSITION"],
        "rotations": found["ROTATION"][:, [3, 0, 1, 2]],
        "scales": found["SCALE"],
        "opacities": found["OPACITY"],
        "sh": np.stack([found[name] for name in degrees], axis=1),
    }


def read_usd(path):
    """The attributes of the default prim by usd-core, after its own checks of the stage."""
    from pxr import Usd, UsdGeom, UsdValidation, UsdVol

    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
    prim = stage.GetDefaultPrim()
    splats = UsdVol.ParticleField3DGaussianSplat(prim)
    assert splats and prim.IsA(UsdVol.ParticleField) and prim.HasAPI(UsdVol.ParticleFieldKernelGaussianEllipsoidAPI)
    declared = prim.GetPrimDefinition().GetPropertyNames()
    foreign = [name for name in prim.GetAuthoredPropertyNames() if name not in declared]
    assert not foreign, f"the schema has no {foreign}"
    registry = UsdValidation.ValidationRegistry()
    problems = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators()).Validate(stage)
    assert not problems, [problem.GetMessage() for problem in problems]
    print(f"ok  schema and {len(registry.GetOrLoadAllValidators())} validators")
    get = lambda name: np.array(prim.GetAttribute(name).Get(), dtype=np.float64)
    positions, quats = get("positions"), prim.GetAttribute("orientations").Get()
    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()
    sh = get("radiance:sphericalHarmonicsCoefficients").reshape(len(positions), (degree + 1) ** 2, 3)
    low, high = get("extent")
    assert np.all(low <= positions.min(axis=0)) and np.all(positions.max(axis=0) <= high)
    return {
        "positions": positions,
        "rotations": np.array([[quat.GetReal(), *quat.GetImaginary()] for quat in quats]),
        "scales": get("scales"),
        "opacities": get("opacities")[:, None],
        "sh": sh,
    }


def read_ply(path):
    data = PlyData.read(str(path))["vertex"]
    columns = lambda *names: np.stack([data[name] for name in names], axis=1).astype(np.float64)
    rest = sum(name.startswith("f_rest_") for name in data.data.dtype.names)
    sh = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None, :]
    if rest:
        planes = columns(*(f"f_rest_{i}" for i in range(rest))).reshape(len(sh), 3, -1)
        sh = np.concatenate([sh, planes.transpose(0, 2, 1)], axis=1)
    quats = columns("rot_0", "rot_1", "rot_2", "rot_3")
    return {
        "positions": columns("x", "y", "z"),
        "scales": np.exp(columns("scale_0", "scale_1", "scale_2")),
        "opacities": 1 / (1 + np.exp(-columns("opacity"))),
        "rotations": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "sh": sh,
    }


def covariances(quats, scales):
    """R S S^T R^T of unit quaternions (w, x, y, z)."""
    w, x, y, z = quats.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    turns = np.moveaxis(np.array(rows), 2, 0)
    return np.einsum("nij,nj,nkj->nik", turns, scales**2, turns)


def basis(direction, count):
    """The real spherical harmonics of 3DGS up to degree 3."""
    x, y, z = direction
    xx, yy, zz = x * x, y * y, z * z
    values = [
        0.28209479177387814,
        -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy), 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return np.array(values[:count])


def main():
    path = pathlib.Path(sys.argv[1])
    read = read_glb(path) if path.suffix == ".glb" else read_usd(path)
    ply = read_ply(sys.argv[2] if len(sys.argv) > 2 else path.with_name("model.ply"))
    turn = np.array([1.0, -1.0, -1.0])
    # Axes may point either way, so rotations and scales are compared as covariances.
    ply_covariances = covariances(ply["rotations"], ply["scales"]) * np.outer(turn, turn)
    read_covariances = covariances(read["rotations"], read["scales"])
    sizes = np.max(ply["scales"], axis=1)[:, None, None] ** 2

    count = ply["sh"].shape[1]
    degree = int(np.sqrt(count)) - 1
    direction = np.array([0.48, -0.6, 0.64])
    seen = ((direction, ply["sh"]), (turn * direction, read["sh"]))
    colors = [np.einsum("k,nkc->nc", basis(d, count), of) for d, of in seen]

    pairs = {
        "positions": (read["positions"], ply["positions"] * turn),
        "scales": (read["scales"], ply["scales"]),
        "opacities": (read["opacities"], ply["opacities"]),
        "covariances": (read_covariances / sizes, ply_covariances / sizes),
        f"colours of degree {degree} from a direction": (colors[1], colors[0]),
    }
    failed = 0
    for name, (found, wanted) in pairs.items():
        assert found.shape == wanted.shape, name
        error = np.max(np.abs(found - wanted) / (1e-2 + np.abs(wanted)))
        print(f"{'ok' if error < 1e-4 else 'BAD':3} {name}: relative error {error:.1e} at most")
        failed += not error < 1e-4
    print(f"{len(read['positions'])} Gaussians")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
