#!/usr/bin/env python3
"""Reads a run's model.glb with pygltflib and compares every number with model.ply, read by plyfile.

    python3 -m venv env && env/bin/pip install numpy plyfile pygltflib
    nightsplat export RUN --format glb && env/bin/python scripts/read-glb.py RUN

glTF has y up: positions, rotations and the directions of SH are rotated by half a turn about x.
"""

import pathlib
import sys

import numpy as np
from plyfile import PlyData
from pygltflib import GLTF2

EXTENSION = "KHR_gaussian_splatting"


def read_glb(path):
    """The attributes of the one primitive, as the accessors describe them."""
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
    return found


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
    run = pathlib.Path(sys.argv[1])
    glb, ply = read_glb(run / "model.glb"), read_ply(run / "model.ply")
    turn = np.array([1.0, -1.0, -1.0])
    # Axes may point either way, so rotations and scales are compared as covariances.
    ply_covariances = covariances(ply["rotations"], ply["scales"]) * np.outer(turn, turn)
    glb_covariances = covariances(glb["ROTATION"][:, [3, 0, 1, 2]], glb["SCALE"])
    sizes = np.max(ply["scales"], axis=1)[:, None, None] ** 2

    count = ply["sh"].shape[1]
    degree = int(np.sqrt(count)) - 1
    names = [f"SH_DEGREE_{l}_COEF_{k}" for l in range(degree + 1) for k in range(2 * l + 1)]
    sh = np.stack([glb[name] for name in names], axis=1)
    direction = np.array([0.48, -0.6, 0.64])
    colors = [np.einsum("k,nkc->nc", basis(d, count), of) for d, of in ((direction, ply["sh"]), (turn * direction, sh))]

    pairs = {
        "positions": (glb["POSITION"], ply["positions"] * turn),
        "scales": (glb["SCALE"], ply["scales"]),
        "opacities": (glb["OPACITY"], ply["opacities"]),
        "covariances": (glb_covariances / sizes, ply_covariances / sizes),
        f"colours of degree {degree} from a direction": (colors[1], colors[0]),
    }
    failed = 0
    for name, (read, wanted) in pairs.items():
        assert read.shape == wanted.shape, name
        error = np.max(np.abs(read - wanted) / (1e-2 + np.abs(wanted)))
        print(f"{'ok' if error < 1e-4 else 'BAD':3} {name}: relative error {error:.1e} at most")
        failed += not error < 1e-4
    print(f"{len(glb['POSITION'])} Gaussians")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
