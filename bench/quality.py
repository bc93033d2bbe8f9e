#!/usr/bin/env python3
"""Held-out quality of `gsfix fix`: arms x view counts x seeds, paired.

    bench/quality.py --gsfix build/gsfix --scene SCENE --out DIR [--views 3,6,9] [--seeds 5] [--jobs 2]
                     [--model SPLATS.ply] [--arm NAME="ARGS" ...] [--common "ARGS"] [--size "ARGS"]

Each run is `gsfix fix SCENE --views K --seed S ARGS --threads 1`; runs that DIR already holds are not repeated. --model
is a model of all views (made first if not given): it fixes which pixels of each test view count as seen. --size is what
masks and runs have in common, as "--max-size 240". Writes DIR/quality.csv and DIR/quality.md: means per arm, and the mean
differences to the arm before and to the first one, with their standard errors over the seeds. Only the standard library
is needed.
"""
import argparse
import concurrent.futures
import csv
import json
import math
import os
import shlex
import subprocess
import sys

DEFAULT_ARMS = [
    ("plain", "--restorer none --regularize off"),
    ("none", "--restorer none --regularize on"),
    ("warp", "--restorer warp --regularize on"),
]
FIGURES = ("psnr", "ssim", "psnr_seen", "ssim_seen")


def run(command):
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        sys.exit("failed (%d): %s\n  %s" % (done.returncode, " ".join(command), last))
    return done.stdout


def mean_and_error(values):
    n = len(values)
    mean = sum(values) / n
    if n < 2:
        return mean, float("nan")
    return mean, math.sqrt(sum((v - mean) ** 2 for v in values) / (n - 1) / n)


def fix(options, views, seed, arm, extra):
    out = os.path.join(options.out, "K%s" % views, arm, "seed%d" % seed)
    metrics = os.path.join(out, "metrics.json")
    if not os.path.exists(metrics):
        command = [options.gsfix, "fix", options.scene, "--out", out, "--views", str(views), "--seed", str(seed),
                   "--threads", "1", "--masks", os.path.join(options.out, "masks_K%s" % views)]
        run(command + shlex.split(options.size) + shlex.split(options.common) + shlex.split(extra))
    with open(metrics) as file:
        return json.load(file)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gsfix", default="build/gsfix")
    parser.add_argument("--scene", required=True)
    parser.add_argument("--out", required=True)
    parser.add_argument("--views", default="3,6,9")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--model")
    parser.add_argument("--common", default="")
    parser.add_argument("--size", default="")
    parser.add_argument("--arm", action="append", default=[])
    options = parser.parse_args()
    arms = [tuple(text.split("=", 1)) for text in options.arm] or DEFAULT_ARMS
    os.makedirs(options.out, exist_ok=True)

    model = options.model or os.path.join(options.out, "all", "splats.ply")
    if not os.path.exists(model):
        run([options.gsfix, "fix", options.scene, "--out", os.path.dirname(model), "--views", "all", "--restorer", "none",
             "--regularize", "off", "--seed", "1"])
    for views in options.views.split(","):
        masks = os.path.join(options.out, "masks_K%s" % views)
        if not os.path.isdir(masks):
            run([options.gsfix, "masks", options.scene, "--views", views, "--model", model, "--out", masks] +
                shlex.split(options.size))

    jobs = [(views, seed, name, extra) for seed in range(1, options.seeds + 1)
            for views in options.views.split(",") for name, extra in arms]
    results = {}
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        futures = {pool.submit(fix, options, *job): job for job in jobs}
        for future in concurrent.futures.as_completed(futures):
            views, seed, name, _ = futures[future]
            results[views, name, seed] = metrics = future.result()
            print("K=%s %-10s seed %d: psnr %.3f seen %.3f  %.1f s" % (
                views, name, seed, metrics["psnr"], metrics.get("psnr_seen") or float("nan"),
                metrics["seconds"]["total"]), flush=True)

    seeds = range(1, options.seeds + 1)
    lines = ["| K | arm | PSNR | SSIM | PSNR seen | SSIM seen | splats | CPU seconds |", "|---|---|---|---|---|---|---|---|"]
    with open(os.path.join(options.out, "quality.csv"), "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("views", "arm", "seed") + FIGURES + ("splats", "seconds"))
        for views in options.views.split(","):
            for name, _ in arms:
                rows = [results[views, name, seed] for seed in seeds]
                for seed, row in zip(seeds, rows):
                    table.writerow([views, name, seed] + [row.get(f) for f in FIGURES] +
                                   [row["splats"], row["seconds"]["total"]])
                cells = ["%.3f" % mean_and_error([r.get(f) or float("nan") for r in rows])[0] for f in FIGURES]
                lines.append("| %s | %s | %s | %d | %.1f |" % (
                    views, name, " | ".join(cells), sum(r["splats"] for r in rows) / len(rows),
                    sum(r["seconds"]["total"] for r in rows) / len(rows)))
    lines += ["", "Paired differences (mean +- standard error over %d seeds):" % options.seeds, "",
              "| K | difference | PSNR | PSNR seen | SSIM seen |", "|---|---|---|---|---|"]
    names = [name for name, _ in arms]
    pairs = list(zip(names[1:], names)) + [(name, names[0]) for name in names[2:]]
    for views in options.views.split(","):
        for better, worse in pairs:
            cells = []
            for figure in ("psnr", "psnr_seen", "ssim_seen"):
                both = [(results[views, better, s].get(figure), results[views, worse, s].get(figure)) for s in seeds]
                if any(a is None or b is None for a, b in both):
                    cells.append("-")
                    continue
                cells.append("%+.3f +- %.3f" % mean_and_error([a - b for a, b in both]))
            lines.append("| %s | %s - %s | %s |" % (views, better, worse, " | ".join(cells)))
    text = "\n".join(lines) + "\n"
    with open(os.path.join(options.out, "quality.md"), "w") as file:
        file.write(text)
    print(text)


if __name__ == "__main__":
    main()
