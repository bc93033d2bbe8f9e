#!/usr/bin/env python3
"""Runs bench_metrics and the Python packages on the same cases and prints the ratios.

    bench/peers_metrics.py BENCH_METRICS [--quick] [--filter TEXT] [--threads N] [--frames N] [--models FOLDER]

BENCH_METRICS is the built program; its rows are passed through. The packages are timed after all of ours, with the same number
of threads, frame by frame on frames of the same size. That row has the package as variant, "ratio" (its seconds divided by
ours; above 1 we are faster) and "cpu_ratio" (the same for CPU seconds, for machines that are not idle). The packages:
scikit-image, torchmetrics, pytorch-msssim, lpips, and PyTorch for what GSFixer's loss_utils.py does (ssim_3dgs). I2V has
torchvision's ViT-B/16 in the place of DINO and of DreamSim's three networks: the same architecture, without CLIP's norm and
projection. Motion smoothness has peer_amt.py: AMT is published as a repository. Weights are random. Preparing frames is timed
on both sides.

Needs PyTorch, torchvision, numpy, safetensors, scikit-image, torchmetrics, pytorch-msssim and lpips; cases whose package is
missing are skipped.
"""
import argparse
import json
import math
import os
import re
import subprocess
import sys
import time

import numpy as np
import torch

KEEP_MEMORY = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": "2000000000"}  # read by glibc at program start


def tensor(image):
    return torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255


def gaussian(channels):
    g = torch.tensor([math.exp(-(x - 5) ** 2 / 4.5) for x in range(11)])
    g = g / g.sum()
    return (g[:, None] @ g[None])[None, None].expand(channels, 1, 11, 11).contiguous()


def ssim_3dgs(window):
    conv = torch.nn.functional.conv2d

    def run(a, b):
        x, y = tensor(a), tensor(b)
        mx, my, xx, yy, xy = (conv(v, window, padding=5, groups=3) for v in (x, y, x * x, y * y, x * y))
        vx, vy, c = xx - mx * mx, yy - my * my, xy - mx * my
        return (((2 * mx * my + 1e-4) * (2 * c + 9e-4)) / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4))).mean().item()
    return run


def vit(count, side):
    import torchvision
    f = torchvision.transforms.functional
    models = [torchvision.models.vit_b_16(weights=None).eval() for _ in range(count)]

    def run(a, b):
        x = torch.from_numpy(a).permute(2, 0, 1).float()
        x = f.resize(x, side, f.InterpolationMode.BICUBIC, antialias=True)
        x = f.center_crop(x, 224)[None] / 255
        return [model(x) for model in models]
    return run


def packages(name, models):
    """(package, function of two frames) for a case."""
    if name == "psnr":
        import skimage.metrics
        yield "scikit-image", lambda a, b: skimage.metrics.peak_signal_noise_ratio(a, b)
    elif name == "ssim_3dgs":
        yield "PyTorch", ssim_3dgs(gaussian(3))
    elif name == "ssim_torchmetrics":
        import torchmetrics.functional.image as tm
        yield "torchmetrics", lambda a, b: tm.structural_similarity_index_measure(tensor(a), tensor(b), data_range=1.0)
    elif name == "ssim_skimage":
        import skimage.metrics
        yield "scikit-image", lambda a, b: skimage.metrics.structural_similarity(a, b, channel_axis=2, data_range=255)
    elif name == "ms_ssim":
        import pytorch_msssim
        yield "pytorch-msssim", lambda a, b: pytorch_msssim.ms_ssim(tensor(a), tensor(b), data_range=1.0)
    elif name == "ms_ssim_torchmetrics":
        import torchmetrics.functional.image as tm
        yield "torchmetrics", lambda a, b: tm.multiscale_structural_similarity_index_measure(
            tensor(a), tensor(b), data_range=1.0, normalize="relu")
    elif name == "temporal_flickering":  # as VBench, which has OpenCV's absdiff in this place
        yield "numpy", lambda a, b: np.abs(a.astype(np.int16) - b).mean()
    elif name.startswith("lpips_"):
        import lpips
        loss = lpips.LPIPS(net=name[6:], pnet_rand=True, verbose=False).eval()
        yield "lpips", lambda a, b: loss(tensor(a), tensor(b), normalize=True)
    elif name == "i2v_subject":
        yield "torchvision", vit(1, 256)
    elif name == "i2v_background":
        yield "torchvision", vit(3, (224, 224))
    elif name == "motion_smoothness":
        import peer_amt
        net = peer_amt.Amt(os.path.join(models, "amt-s.safetensors"))

        def between(a, b):  # the middle frame in 8 bits, and its distance from a frame
            middle = (255 * net.interpolate(tensor(a), tensor(b))[0]).byte().permute(1, 2, 0).numpy()
            return np.abs(middle.astype(np.int16) - a).mean()
        yield "PyTorch", between


def frames_of(height, width):
    generator = np.random.default_rng(3)
    base = generator.integers(0, 200, (height, width, 3), dtype=np.uint8)
    return base, (base + generator.integers(0, 30, base.shape, dtype=np.uint8)).astype(np.uint8)


def measure(function, a, b, calls):
    function(a, b)
    start, cpu = time.perf_counter(), time.process_time()
    for _ in range(calls):
        function(a, b)
    return time.perf_counter() - start, time.process_time() - cpu


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bench")
    parser.add_argument("--quick", action="store_true")
    for name in ("filter", "threads", "frames", "models"):
        parser.add_argument("--" + name)
    options = parser.parse_args()
    if any(os.environ.get(key) != value for key, value in KEEP_MEMORY.items()):
        os.execve(sys.executable, [sys.executable] + sys.argv, {**os.environ, **KEEP_MEMORY})
    command = [options.bench, "--json"] + ["--quick"] * options.quick
    for name in ("filter", "threads", "frames", "models"):
        if getattr(options, name):
            command += ["--" + name, getattr(options, name)]
    ours = [json.loads(line) for line in
            subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()]
    for row in ours:
        print(json.dumps(row), flush=True)
        name, width, height, frames = re.match(r"(\S+) (\d+)x(\d+) N=(\d+)$", row["case"]).groups()
        torch.set_num_threads(row["threads"])
        a, b = frames_of(int(height), int(width))
        try:
            with torch.inference_mode():
                for package, function in packages(name, options.models or "bench_metrics.models"):
                    calls = (int(frames) - 1) // 2 if name == "motion_smoothness" else int(frames)  # every other frame
                    seconds, cpu = measure(function, a, b, calls)
                    theirs = {key: row[key] for key in ("bench", "case", "isa", "threads", "work", "work_unit")}
                    theirs.update(variant=package, seconds=seconds, cpu_seconds=cpu, rate=row["work"] / seconds,
                                  reference="none", ratio=round(seconds / row["seconds"], 3),
                                  cpu_ratio=round(cpu / row["cpu_seconds"], 3))
                    print(json.dumps(theirs), flush=True)
        except ImportError as missing:
            print("peers_metrics.py: %s: %s" % (name, missing), file=sys.stderr)


main()
