#!/usr/bin/env python3
"""Times the rasteriser of gsplat forward and backward on a scene like that of `nightsplat bench`, and prints JSON.

Needs torch with CUDA, and gsplat with its kernels built. The scene has the same distributions, not the same random
numbers: number, sizes, opacities and depths of the Gaussians, and the size of the image.
"""

import argparse
import json
import statistics

import gsplat
import torch


def scene(count, width, height):
    """Means, quaternions, scales, opacities and SH coefficients of degree 3, as leaves with gradients."""
    torch.manual_seed(65)
    focal = 0.9 * width
    center = torch.tensor([0.51 * width, 0.49 * height])
    depth = 2 + 4 * torch.rand(count, 1)
    pixels = torch.rand(count, 2) * torch.tensor([float(width), float(height)])
    means = torch.cat([(pixels - center) / focal * depth, depth], dim=1)
    scales = (0.545 + 0.8 * torch.randn(count, 3)).exp().clamp(0.6, 20) * depth / focal
    opacities = 0.03 + 0.9 * torch.rand(count) ** 2
    colors = 0.05 * torch.randn(count, 16, 3)
    colors[:, 0] = torch.randn(count, 3) / 0.2820948 / 6
    leaves = [means, torch.randn(count, 4), scales, opacities, colors]
    intrinsics = torch.tensor([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])
    return [leaf.cuda().requires_grad_() for leaf in leaves], intrinsics.cuda()[None]


def measure(count, width, height, repeats):
    """Median milliseconds of the forward and the backward pass, after two warm-up runs."""
    (means, quats, scales, opacities, colors), intrinsics = scene(count, width, height)
    view = torch.eye(4, device="cuda")[None]
    times = []
    for _ in range(repeats + 2):
        events = [torch.cuda.Event(enable_timing=True) for _ in range(3)]
        events[0].record()
        render, _, info = gsplat.rasterization(
            means, quats, scales, opacities, colors, view, intrinsics, width, height, sh_degree=3
        )
        events[1].record()
        render.backward(torch.full_like(render, 1e-3))
        events[2].record()
        torch.cuda.synchronize()
        times.append([events[0].elapsed_time(events[1]), events[1].elapsed_time(events[2])])
    forward, backward = (statistics.median(column) for column in zip(*times[2:]))
    return {
        "gaussians": count,
        "width": width,
        "height": height,
        "intersections": int(info["flatten_ids"].numel()),
        "forward_ms": forward,
        "backward_ms": backward,
        "peak_bytes": torch.cuda.max_memory_allocated(),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=9)
    repeats = parser.parse_args().repeats
    cases = [(100_000, 500, 375), (100_000, 1920, 1080), (1_000_000, 1920, 1080)]
    report = {"device": torch.cuda.get_device_name(), "gsplat": gsplat.__version__}
    report["cases"] = [measure(*case, repeats) for case in cases]
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
