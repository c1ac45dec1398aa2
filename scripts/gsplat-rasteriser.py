#!/usr/bin/env python3
"""Times gsplat on the scene of `nightsplat bench --ply FILE`, and prints JSON.

Needs torch with CUDA, and gsplat with its kernels built. A step is rasterisation, L1, SSIM if the package `fused_ssim`
is there, the backward pass and torch's fused Adam. Beside the times on the wall are sums of the kernels' own times,
from which the gaps that Python leaves are missing.
"""

import argparse
import json
import statistics
import time

import gsplat
import torch

PROPERTIES = ["x", "y", "z", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity"]
REST = 45
WARM, TIMED = 50, 50


def scene(path):
    """Means, quaternions, logarithms of scales, raw opacities and SH coefficients of degree 3, as leaves."""
    with open(path, "rb") as file:
        header = b""
        while not header.endswith(b"end_header\n"):
            header += file.readline()
        data = torch.frombuffer(bytearray(file.read()), dtype=torch.float32)
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property")]
    columns = data.reshape(-1, len(names)).T

    def of(*wanted):
        return torch.stack([columns[names.index(name)] for name in wanted], dim=1)

    dc = of("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    # The file has all coefficients of a channel together.
    rest = of(*(f"f_rest_{i}" for i in range(REST))).reshape(-1, 3, REST // 3).transpose(1, 2)
    shape = of(*PROPERTIES)
    leaves = [shape[:, 0:3], shape[:, 6:10], shape[:, 3:6], shape[:, 10], torch.cat([dc, rest], dim=1)]
    return [leaf.contiguous().cuda().requires_grad_() for leaf in leaves]


def ssim_or_none():
    try:
        from fused_ssim import fused_ssim
    except ImportError:
        return None
    return fused_ssim


def measure(path, width, height):
    """Medians over warm runs of a rasterisation forward and backward, and of a whole step, in milliseconds."""
    leaves = scene(path)
    focal = 0.9 * width
    intrinsics = torch.tensor([[[focal, 0, 0.51 * width], [0, focal, 0.49 * height], [0, 0, 1]]]).cuda()
    view = torch.eye(4, device="cuda")[None]
    target = torch.rand(1, height, width, 3, device="cuda")
    ssim = ssim_or_none()
    # No rate: the scene stays what it is.
    adam = torch.optim.Adam(leaves, lr=0.0, fused=True)

    def render():
        means, quats, scales, opacities, colors = leaves
        return gsplat.rasterization(means, quats, scales.exp(), opacities.sigmoid(), colors, view, intrinsics, width,
                                    height, sh_degree=3)

    def rasterise():
        image, _, info = render()
        image.backward(torch.full_like(image, 1e-3))
        return int(info["flatten_ids"].numel())

    def step():
        image, _, _ = render()
        loss = 0.8 * (image - target).abs().mean()
        if ssim:
            loss = loss + 0.2 * (1 - ssim(image.permute(0, 3, 1, 2), target.permute(0, 3, 1, 2)))
        loss.backward()
        adam.step()
        adam.zero_grad(set_to_none=True)

    report = {"gaussians": len(leaves[0]), "width": width, "height": height, "has_ssim": ssim is not None}
    report["intersections"] = rasterise()
    for name, run in ("rasteriser", rasterise), ("step", step):
        report[f"{name}_ms"], report[f"{name}_kernels_ms"] = timed(run)
    report["peak_bytes"] = torch.cuda.max_memory_allocated()
    return report


def timed(run):
    """The median on the wall, each run awaited, and the mean of the kernels' sums."""
    for _ in range(WARM):
        run()
    torch.cuda.synchronize()
    times = []
    for _ in range(TIMED):
        begin = time.perf_counter()
        run()
        torch.cuda.synchronize()
        times.append(1e3 * (time.perf_counter() - begin))
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        for _ in range(TIMED):
            run()
        torch.cuda.synchronize()
    kernels = sum(event.self_device_time_total for event in profile.key_averages())
    return statistics.median(times), kernels * 1e-3 / TIMED


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ply", required=True)
    parser.add_argument("--size", type=int, nargs=2, default=[1920, 1080])
    arguments = parser.parse_args()
    report = {"device": torch.cuda.get_device_name(), "gsplat": gsplat.__version__}
    report |= measure(arguments.ply, *arguments.size)
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
