#!/usr/bin/env python3
"""Tests scripts/lpips-weights.py on planted weights, without network access and without numpy.

    scripts/test-lpips-weights.py [--keep FOLDER]      (keeps lpips-alex.safetensors and lpips-vgg.safetensors)
"""

import argparse
import array
import importlib.util
import math
import os
import pickle
import subprocess
import sys
import tempfile
import types
import unittest
from pathlib import Path

SCRIPT = Path(__file__).resolve().parent / "lpips-weights.py"
SPEC = importlib.util.spec_from_file_location("lpips_weights", SCRIPT)
weights = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(weights)


class Planted:
    """Pickles like a numpy array of 32-bit floats; repeats a prime number of values."""

    def __init__(self, *shape, code="f4", missing=0, period=[at / 4093 for at in range(4093)]):
        self.shape, self.code, self.missing = shape, code, missing
        self.period = array.array("f", period)

    def value(self, *index):
        at = 0
        for extent, place in zip(self.shape, index):
            at = at * extent + place
        return self.period[at % len(self.period)]

    def __reduce__(self):
        count = math.prod(self.shape) - self.missing
        values = (self.period * (count // len(self.period) + 1))[:count]
        if sys.byteorder == "big":
            values.byteswap()
        numpy = sys.modules["numpy"]
        state = (1, self.shape, numpy.dtype(self.code, False, True), False, values.tobytes())
        return sys.modules["numpy.core.multiarray"]._reconstruct, (numpy.ndarray, (0,), b"b"), state


def stand_in_for_numpy():
    """The parts of numpy that its pickles name."""
    numpy, multiarray = types.ModuleType("numpy"), types.ModuleType("numpy.core.multiarray")

    class ndarray:
        pass

    class dtype:
        def __init__(self, *arguments):
            self.arguments = arguments

        def __reduce__(self):
            return dtype, self.arguments, (3, "<", None, None, None, -1, -1, 0)

    def _reconstruct(*_):
        pass

    for module, thing in [(numpy, ndarray), (numpy, dtype), (multiarray, _reconstruct)]:
        thing.__module__, thing.__qualname__ = module.__name__, thing.__name__
        setattr(module, thing.__name__, thing)
    names = {"numpy": numpy, "numpy.core": types.ModuleType("numpy.core"), "numpy.core.multiarray": multiarray}
    sys.modules.update(names)


def planted(net):
    """The package's tree of a network."""
    _, trunk, convolutions, compared = weights.NETWORKS[net]
    layers = {
        f"Conv_{index}": {"kernel": Planted(window, window, inputs, outputs), "bias": Planted(outputs)}
        for index, (_, outputs, inputs, window) in enumerate(convolutions)
    }
    lins = {
        f"NetLinLayer_{index}": {"Conv_0": {"kernel": Planted(1, 1, channels, 1)}}
        for index, channels in enumerate(compared)
    }
    return {trunk: layers, **lins}


class Malicious:
    """Would create a folder when read."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (self.folder,)


class Conversion(unittest.TestCase):
    KEEP = None

    def refused(self, tree, *parts):
        with self.assertRaises(weights.Refused) as raised:
            weights.converted(pickle.dumps(tree, protocol=3), "alex")
        for part in parts:
            self.assertIn(part, str(raised.exception))

    def test_every_tensor_is_where_pytorch_has_it(self):
        with tempfile.TemporaryDirectory() as folder:
            for net, (_, trunk, convolutions, compared) in weights.NETWORKS.items():
                tree = planted(net)
                tensors = weights.converted(pickle.dumps(tree, protocol=3), net)
                path = Path(self.KEEP or folder, f"lpips-{net}.safetensors")
                weights.write(path, tensors)
                self.assertEqual(weights.read(path), tensors)
                found = {name: (shape, values) for name, shape, values in weights.read(path)}
                self.assertEqual(len(found), 2 * len(convolutions) + len(compared))
                for index, (place, outputs, inputs, window) in enumerate(convolutions):
                    shape, values = found[f"net.{place}.weight"]
                    self.assertEqual(shape, [outputs, inputs, window, window])
                    kernel = tree[trunk][f"Conv_{index}"]["kernel"]
                    for o, i, y, x in [(0, 0, 0, 1), (outputs - 1, 1, 2, 0), (5, inputs - 1, 1, 2)]:
                        at = ((o * inputs + i) * window + y) * window + x
                        self.assertEqual(values[at], kernel.value(y, x, i, o), (place, o, i, y, x))
                    self.assertEqual(found[f"net.{place}.bias"][0], [outputs])
                for index, channels in enumerate(compared):
                    shape, values = found[f"lin{index}.model.1.weight"]
                    self.assertEqual((shape, values[3]), ([1, channels, 1, 1], Planted(channels).value(3)))

    def test_a_pickle_that_names_anything_but_arrays_is_refused_and_runs_nothing(self):
        with tempfile.TemporaryDirectory() as folder:
            trap = os.path.join(folder, "made")
            self.refused({**planted("alex"), "beside": Malicious(trap)}, "mkdir", "not an array")
            self.assertFalse(os.path.exists(trap))

    def test_weights_of_another_shape_or_kind_are_named(self):
        tree = planted("alex")
        tree["AlexNet_0"]["Conv_2"]["bias"] = Planted(383)
        self.refused(tree, "AlexNet_0/Conv_2/bias", "(383,)", "(384,)")
        del tree["AlexNet_0"]["Conv_2"]
        self.refused(tree, "AlexNet_0/Conv_2/kernel is missing")
        self.refused({"AlexNet_0": Planted(3, code="f8")}, "<f8")
        self.refused({"AlexNet_0": Planted(3, missing=1)}, "shape (3,) with 2 values")
        self.refused([], "missing")
        with self.assertRaises(weights.Refused):
            weights.converted(pickle.dumps(planted("alex"), protocol=3)[:-9], "alex")

    def test_values_that_no_distance_has_are_refused(self):
        tree = planted("alex")
        not_finite = "lin0.model.1.weight holds values that are not finite"
        for value, part in [(-0.5, "layer 0 is negative"), (float("nan"), not_finite)]:
            tree["NetLinLayer_0"]["Conv_0"]["kernel"] = Planted(1, 1, 64, 1, period=[0.5, value])
            self.refused(tree, part)

    def test_another_archive_is_refused(self):
        with tempfile.TemporaryDirectory() as folder:
            archive = Path(folder, "lpips.tar.gz")
            archive.write_bytes(b"something else")
            command = [sys.executable, SCRIPT, "vgg", "--package", archive, "--out", Path(folder, "out")]
            run = subprocess.run(command, capture_output=True, text=True)
            self.assertEqual((run.returncode, len(run.stderr.splitlines())), (1, 1), run.stderr)
            self.assertIn("SHA-256", run.stderr)
            self.assertFalse(Path(folder, "out").exists())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the converted files here")
    Conversion.KEEP = parser.parse_args().keep
    stand_in_for_numpy()
    unittest.main(argv=sys.argv[:1])
