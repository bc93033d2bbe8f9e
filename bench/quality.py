#!/usr/bin/env python3
"""Held-out quality of `gsfix fix`: starts x view counts x arms x seeds, paired by seed.

    bench/quality.py --gsfix build/gsfix --scene SCENE --out DIR [--starts tracks,default] [--views 3,6,9] [--seeds 5]
                     [--iterations 1200] [--jobs 1] [--opensplat PROGRAM] [--model SPLATS.ply] [--arm NAME="ARGS" ...]
                     [--common "ARGS"] [--size "ARGS"] [--tables]

Each run is `gsfix fix SCENE --views K --seed S ARGS --threads 1`. The starts:

    tracks    the points that have a track in a training photo, as in the papers (--init tracks)
    default   the default of gsfix fix: with fewer than 6 photos also the points that a ray from a training photo reaches,
              with 6 or more these and the points of stereo between the training photos. Rays keep points that have tracks
              only in held-out photos. If the model was built from all photos, that is welcome in practice but leaks
              information into a comparison.

In both cases poses and point positions come from the COLMAP model in SCENE. --opensplat adds OpenSplat's command-line
program (1.2.0) as a peer. It gets a COLMAP folder with the training photos only and the points of the start (for
default: those by track or ray), the same number of steps, one thread and the same black background; `gsfix render` and
`gsfix metrics` measure its splats over the same pixels. Its random seed is fixed, so one run suffices. `OpenSplat` uses
its own schedule, which performs Adam's step only every 32nd and later every 64th time in the second half of a run.
`OpenSplat+` performs it every time, densifies every 100 steps and adds an SH band every 300 steps, which suits runs as
short as these.

--model is a model of all views (trained first if not given) that defines which pixels of each test view count as seen.
--size holds options that masks and runs share, such as "--max-size 240" (not together with a peer). A run that has left
result.json is not repeated, so that an interrupted call can be continued; K = 3 runs first. DIR/quality.csv has one row
per run, DIR/quality.md the means and the paired differences with their standard errors; --tables writes both from the
existing results without running anything. CPU seconds are those of the whole process. Needs only the standard library.
"""
import argparse
import concurrent.futures
import csv
import json
import os
import shlex
import shutil
import struct
import sys

from runs import mean_and_error, read_json, run, write_json

DEFAULT_ARMS = [
    ("plain", "--restorer none --regularize off"),
    ("none", "--restorer none --regularize on"),
    ("warp", "--restorer warp --regularize on"),
]
STARTS = {"tracks": ("--init tracks", "tracks"), "default": ("", "both")}  # options of fix; --method of filter, for the peer
PEER_ARMS = [("OpenSplat", ""),
             ("OpenSplat+", "--densify-from 100 --densify-until {steps} --refine-every 100 --sh-degree-interval 300")]
FIGURES = ("psnr", "ssim", "psnr_seen", "ssim_seen")


def mean_of(rows, figure):
    values = [row[figure] for row in rows if row.get(figure) is not None]
    return sum(values) / len(values) if values else float("nan")


# ---- the runs ------------------------------------------------------------------------

def folder_of(options, job):
    start, views, arm, seed = job
    return os.path.join(options.out, start, "K%s" % views, arm, "seed%d" % seed)


def masks_of(options, views):
    return os.path.join(options.out, "masks_K%s" % views)


def result_of(options, job):
    return read_json(os.path.join(folder_of(options, job), "result.json"))


def fix(options, job, extra):
    start, views, _, seed = job
    out = folder_of(options, job)
    command = [options.gsfix, "fix", options.scene, "--out", out, "--restart", "--views", views, "--seed", str(seed),
               "--threads", "1", "--iterations", str(options.iterations), "--masks", masks_of(options, views)]
    command += shlex.split(STARTS[start][0]) + shlex.split(options.size) + shlex.split(options.common) + shlex.split(extra)
    _, cpu = run(command)
    metrics = read_json(os.path.join(out, "metrics.json"))
    row = {figure: metrics.get(figure) for figure in FIGURES}
    row.update(points=metrics["switches"]["initial_splats"],
               splats=metrics["splats"], cpu_seconds=cpu)
    return row


def training_scene(options, start, views, out):
    """Makes a COLMAP folder with the training photos only and the points of the start; returns the number of points."""
    text, _ = run([options.gsfix, "filter", options.scene, "--views", views, "--method", STARTS[start][1], "--out", out,
                   "--json"])
    kept = json.loads(text)["kept"]
    path = os.path.join(out, "sparse", "0", "images.bin")
    with open(path, "rb") as file:
        data = file.read()
    train = set(split_of(options, views)["train"])
    at, records = 8, []
    for _ in range(struct.unpack_from("<Q", data)[0]):  # id, pose, camera; name; number of 2D points; per point x, y, id
        end = data.index(b"\0", at + 64) + 1
        points = struct.unpack_from("<Q", data, end)[0]
        name = data[at + 64:end - 1].decode()
        if name in train:
            records.append(data[at:end] + struct.pack("<Q", 0))
            link = os.path.join(out, "images", name)
            os.makedirs(os.path.dirname(link), exist_ok=True)
            os.symlink(os.path.abspath(os.path.join(options.scene, "images", name)), link)
        at = end + 8 + 24 * points
    if len(records) != len(train):
        sys.exit("%s: %d of %d training photos" % (path, len(records), len(train)))
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(records)) + b"".join(records))
    return kept


def split_of(options, views):
    return json.loads(run([options.gsfix, "info", options.scene, "--views", views, "--json"])[0])


def train_peer(options, job, extra, out, ply):
    start, views, _, _ = job
    shutil.rmtree(os.path.join(out, "scene"), ignore_errors=True)
    points = training_scene(options, start, views, os.path.join(out, "scene"))
    command = [options.opensplat, os.path.join(out, "scene"), "-n", str(options.iterations), "-o", ply]
    _, cpu = run(command + shlex.split(extra.format(steps=options.iterations)), OMP_NUM_THREADS="1")
    return {"points": points, "cpu_seconds": cpu}


def peer(options, job, extra):
    views, out = job[1], folder_of(options, job)
    ply, renders, trained = (os.path.join(out, name) for name in ("splats.ply", "renders", "trained.json"))
    if not read_json(trained):
        write_json(trained, train_peer(options, job, extra, out, ply))
    shutil.rmtree(renders, ignore_errors=True)
    run([options.gsfix, "render", ply, "--scene", options.scene, "--out", renders, "--threads", "1"])
    text, _ = run([options.gsfix, "metrics", renders, os.path.join(options.scene, "images"), "--masks",
                   masks_of(options, views), "--json"])
    test = {os.path.splitext(name)[0] for name in split_of(options, views)["test"]}
    rows = [image for image in json.loads(text)["per_image"] if image["name"] in test]
    if len(rows) != len(test):
        sys.exit("%s: %d of %d held-out views" % (renders, len(rows), len(test)))
    info, _ = run([options.gsfix, "info", ply, "--json"])
    return dict(read_json(trained), psnr=mean_of(rows, "psnr"), ssim=mean_of(rows, "ssim_3dgs"),
                psnr_seen=mean_of(rows, "psnr_seen"), ssim_seen=mean_of(rows, "ssim_3dgs_seen"),
                splats=json.loads(info)["splats"])


def work(options, job, body, extra):
    out = folder_of(options, job)
    if result_of(options, job) is None:
        if body is fix:
            shutil.rmtree(out, ignore_errors=True)  # left by an interrupted call
        os.makedirs(out, exist_ok=True)
        write_json(os.path.join(out, "result.json"), body(options, job, extra))
    return result_of(options, job)


def prepare(options):
    model = options.model or os.path.join(options.out, "all", "splats.ply")
    if not os.path.exists(model):
        shutil.rmtree(os.path.dirname(model), ignore_errors=True)
        run([options.gsfix, "fix", options.scene, "--out", os.path.dirname(model), "--restart", "--views", "all",
             "--restorer", "none", "--regularize", "off", "--seed", "1", "--iterations", str(options.iterations),
             "--threads", str(options.jobs)])
    for views in options.views:
        masks = masks_of(options, views)
        if not os.path.isdir(masks):
            shutil.rmtree(masks + ".part", ignore_errors=True)
            run([options.gsfix, "masks", options.scene, "--views", views, "--model", model, "--out", masks + ".part"] +
                shlex.split(options.size))
            os.rename(masks + ".part", masks)


# ---- the tables ----------------------------------------------------------------------

def start_tables(options, start, arms, lines):
    rows = {}  # (views, arm): {seed: result}
    for views in options.views:
        for arm, _, seeds in arms:
            found = {seed: result_of(options, (start, views, arm, seed)) for seed in seeds}
            rows[views, arm] = {seed: row for seed, row in found.items() if row}
    if not any(rows.values()):
        return rows
    lines += ["### Start: %s" % start, "",
              "| K | start | arm | points | PSNR | SSIM | PSNR seen | SSIM seen | splats | CPU seconds | runs |",
              "|---|---|---|---|---|---|---|---|---|---|---|"]
    for views in options.views:
        for arm, _, _ in arms:
            done = list(rows[views, arm].values())
            if done:
                lines.append("| %s | %s | %s | %d | %s | %.0f | %.0f | %d |" % (
                    views, start, arm, mean_of(done, "points"), " | ".join("%.3f" % mean_of(done, f) for f in FIGURES),
                    mean_of(done, "splats"), mean_of(done, "cpu_seconds"), len(done)))
    names = [arm for arm, _, seeds in arms if len(seeds) > 1]
    pairs = list(zip(names[1:], names)) + [(name, names[0]) for name in names[2:]]
    differences = []
    for views in options.views:
        for better, worse in pairs:
            a, b = rows[views, better], rows[views, worse]
            both = sorted(set(a) & set(b))
            if len(both) < 2:
                continue
            cells = []
            for figure in ("psnr", "psnr_seen", "ssim_seen"):
                values = [a[s][figure] - b[s][figure] for s in both if None not in (a[s][figure], b[s][figure])]
                cells.append("%+.3f +- %.3f" % mean_and_error(values) if len(values) > 1 else "-")
            differences.append("| %s | %s | %s - %s | %s | %d |" % (views, start, better, worse, " | ".join(cells), len(both)))
    if differences:
        lines += ["", "Paired by seed, mean +- standard error:", "",
                  "| K | start | difference | PSNR | PSNR seen | SSIM seen | pairs |", "|---|---|---|---|---|---|---|"]
    lines += differences + [""]
    return rows


def write_tables(options, arms):
    lines = []
    with open(os.path.join(options.out, "quality.csv"), "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("start", "views", "arm", "seed") + FIGURES + ("points", "splats", "cpu_seconds"))
        for start in options.starts:
            for (views, arm), found in start_tables(options, start, arms, lines).items():
                for seed, row in found.items():
                    table.writerow([start, views, arm, seed] +
                                   [row.get(f) for f in FIGURES + ("points", "splats", "cpu_seconds")])
    text = "\n".join(lines)
    with open(os.path.join(options.out, "quality.md"), "w") as file:
        file.write(text)
    return text


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gsfix", default="build/gsfix")
    parser.add_argument("--scene", required=True)
    parser.add_argument("--out", required=True)
    parser.add_argument("--starts", default="tracks,default")
    parser.add_argument("--views", default="3,6,9")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--iterations", type=int, default=1200)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--opensplat")
    parser.add_argument("--model")
    parser.add_argument("--common", default="")
    parser.add_argument("--size", default="")
    parser.add_argument("--arm", action="append", default=[])
    parser.add_argument("--tables", action="store_true")
    options = parser.parse_args()
    options.starts, options.views = options.starts.split(","), options.views.split(",")
    unknown = [start for start in options.starts if start not in STARTS]
    if unknown or (options.opensplat and options.size):
        parser.error("no start " + unknown[0] if unknown else "--size and --opensplat exclude each other")
    seeds = range(1, options.seeds + 1)
    arms = [(name, extra, seeds) for name, extra in
            ([tuple(text.split("=", 1)) for text in options.arm] or DEFAULT_ARMS)]
    bodies = {name: fix for name, _, _ in arms}
    if options.opensplat:
        arms += [(name, extra, range(1, 2)) for name, extra in PEER_ARMS]
        bodies.update((name, peer) for name, _ in PEER_ARMS)
    os.makedirs(options.out, exist_ok=True)
    if not options.tables:
        prepare(options)
        jobs = [((start, views, name, seed), extra) for views in options.views for seed in range(1, max(2, options.seeds + 1))
                for start in options.starts for name, extra, its in arms if seed in its]
        with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
            futures = {pool.submit(work, options, job, bodies[job[2]], extra): job for job, extra in jobs}
            for future in concurrent.futures.as_completed(futures):
                start, views, name, seed = futures[future]
                row = future.result()
                print("%-8s K=%s %-10s seed %d: psnr %.3f seen %.3f, %.0f CPU s" % (
                    start, views, name, seed, row["psnr"], row["psnr_seen"] or float("nan"), row["cpu_seconds"]), flush=True)
                write_tables(options, arms)
    print(write_tables(options, arms))


if __name__ == "__main__":
    main()
