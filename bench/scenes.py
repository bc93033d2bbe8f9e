#!/usr/bin/env python3
"""Held-out quality of settings of `gsfix fix` on many scenes: scenes x view counts x arms x seeds, paired by scene and seed.

    bench/scenes.py SCENE... --out DIR --arm NAME[@PROGRAM]="ARGS" ... [--base NAME] [--views 3] [--seeds 1] [--jobs 1]
                    [--size "--max-size 240"] [--common "ARGS"] [--gsfix build/gsfix] [--per-scene] [--tables]

Each run is `gsfix fix SCENE --views K --seed S ARGS --threads 1`. PROGRAM is another build of the program; {scene} in ARGS is
the name of the scene's folder. The tables give, for each view count, PSNR and SSIM over all pixels and CPU seconds per scene,
and the differences from the arm --base (the first one by default): in the mean over scenes with its standard error, for the
scene that loses most, and with --per-scene for each. An arm with --filtered has another one, NAME+filter: the same renders,
cleaned up by the restorer. A run that has left result.json is not repeated; --tables runs nothing.
Needs only the standard library.
"""
import argparse
import concurrent.futures
import csv
import os
import shlex
import shutil

from runs import mean_and_error, read_json, run, split_arm, write_json

FIGURES = ("psnr", "ssim", "splats", "cpu_seconds")
FILTER = "+filter"


def name_of(scene):
    return os.path.basename(os.path.normpath(scene))


def folder_of(options, job):
    scene, views, arm, seed = job
    return os.path.join(options.out, name_of(scene), "K%s" % views, arm, "seed%d" % seed)


def work(options, job, program, extra):
    out = folder_of(options, job)
    path = os.path.join(out, "result.json")
    if read_json(path) is None:
        scene, views, _, seed = job
        shutil.rmtree(out, ignore_errors=True)  # left by an interrupted call
        command = shlex.split(options.prefix) + [
            program, "fix", scene, "--out", os.path.join(out, "run"), "--restart", "--views", views, "--seed", str(seed),
            "--threads", "1", "--eval-every", "1000000", "--checkpoint-every", "1000000"]
        _, cpu = run(command + shlex.split(options.size) + shlex.split(options.common) +
                     shlex.split(extra.replace("{scene}", name_of(scene))))
        metrics = read_json(os.path.join(out, "run", "metrics.json"))
        row = {"psnr": metrics["psnr"], "ssim": metrics["ssim"], "splats": metrics["splats"], "cpu_seconds": cpu}
        write_json(path, dict(row, filtered={f: metrics["filtered"][f] for f in FIGURES[:2]}) if "filtered" in metrics else row)
        if not options.keep:
            shutil.rmtree(os.path.join(out, "run"))
    return read_json(path)


def mean(values):
    return sum(values) / len(values) if values else float("nan")


def result_of(options, job):
    scene, views, arm, seed = job
    row = read_json(os.path.join(folder_of(options, (scene, views, arm.removesuffix(FILTER), seed)), "result.json"))
    if not arm.endswith(FILTER):
        return row
    return dict(row, **row["filtered"]) if row and "filtered" in row else None


def table(options, views, arms):
    found = {}
    for scene in options.scenes:
        for arm in arms:
            rows = {seed: result_of(options, (scene, views, arm, seed)) for seed in range(1, options.seeds + 1)}
            found[scene, arm] = {seed: row for seed, row in rows.items() if row}
    lines = ["### %s photos" % views, "", "| scene | " + " | ".join(arms) + " |", "|---|" + "---|" * len(arms)]
    for scene in options.scenes:
        cells = []
        for arm in arms:
            rows = list(found[scene, arm].values())
            cells.append("%.2f / %.3f" % (mean([r["psnr"] for r in rows]), mean([r["ssim"] for r in rows])) if rows else "")
        lines.append("| %s | %s |" % (name_of(scene), " | ".join(cells)))
    lines.append("| CPU seconds | %s |" % " | ".join(
        "%.0f" % mean([r["cpu_seconds"] for scene in options.scenes for r in found[scene, arm].values()]) for arm in arms))
    lines += ["", "| arm - %s | PSNR | SSIM | worst scene | CPU time | runs |" % options.base, "|---|---|---|---|---|---|"]
    for arm in arms:
        if arm == options.base:
            continue
        psnr, ssim, cpu, count = {}, [], [], 0
        for scene in options.scenes:
            pairs = [(row, found[scene, options.base][seed]) for seed, row in found[scene, arm].items()
                     if seed in found[scene, options.base]]
            if pairs:
                psnr[name_of(scene)] = mean([a["psnr"] - b["psnr"] for a, b in pairs])
                ssim.append(mean([a["ssim"] - b["ssim"] for a, b in pairs]))
                cpu.append(mean([a["cpu_seconds"] / b["cpu_seconds"] for a, b in pairs]))
                count += len(pairs)
        if psnr:
            worst = min(psnr, key=psnr.get)
            lines.append("| %s | %+.3f +- %.3f | %+.4f +- %.4f | %s %+.2f | x %.2f | %d |" % (
                (arm,) + mean_and_error(list(psnr.values())) + mean_and_error(ssim) + (worst, psnr[worst], mean(cpu), count)))
            if options.per_scene:
                lines.append("| | %s | | | | |" % ", ".join("%s %+.2f" % pair for pair in psnr.items()))
    return lines + [""]


def tables(options, arms):
    with open(os.path.join(options.out, "scenes.csv"), "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("scene", "views", "arm", "seed") + FIGURES)
        for scene in options.scenes:
            for views in options.views:
                for arm in arms:
                    for seed in range(1, options.seeds + 1):
                        row = result_of(options, (scene, views, arm, seed))
                        if row:
                            rows.writerow([name_of(scene), views, arm, seed] + [row[f] for f in FIGURES])
    text = "\n".join(line for views in options.views for line in table(options, views, arms))
    with open(os.path.join(options.out, "scenes.md"), "w") as file:
        file.write(text)
    return text


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--out", required=True)
    parser.add_argument("--arm", action="append", required=True)
    parser.add_argument("--base")
    parser.add_argument("--views", default="3")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--size", default="--max-size 240")
    parser.add_argument("--common", default="")
    parser.add_argument("--gsfix", default="build/gsfix")
    parser.add_argument("--prefix", default="", help="words before each command, such as: nice")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--keep", action="store_true", help="keep the output folders of the runs")
    parser.add_argument("--per-scene", action="store_true", help="list the difference on each scene")
    parser.add_argument("--tables", action="store_true")
    options = parser.parse_args()
    options.views = options.views.split(",")
    arms = {}
    for text in options.arm:
        name, program, extra = split_arm(text)
        arms[name] = (program or options.gsfix, extra)
    options.base = options.base or next(iter(arms))
    if options.base not in arms:
        parser.error("--base: no arm " + options.base)
    os.makedirs(options.out, exist_ok=True)
    if not options.tables:
        jobs = [((scene, views, arm, seed), program, extra) for views in options.views for seed in range(1, options.seeds + 1)
                for scene in options.scenes for arm, (program, extra) in arms.items()]
        with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
            futures = {pool.submit(work, options, *job): job[0] for job in jobs}
            for future in concurrent.futures.as_completed(futures):
                scene, views, arm, seed = futures[future]
                row = future.result()
                print("%-16s K=%s %-12s seed %d: psnr %.3f ssim %.4f, %.0f CPU s" % (
                    name_of(scene), views, arm, seed, row["psnr"], row["ssim"], row["cpu_seconds"]), flush=True)
    print(tables(options, [shown for name, (_, extra) in arms.items() for shown in
                           [name] + [name + FILTER] * ("--filtered" in extra.split())]))


if __name__ == "__main__":
    main()
