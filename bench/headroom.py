#!/usr/bin/env python3
"""How much repair could gain: runs of `gsfix fix` with restorers that know the truth.

    bench/headroom.py SCENE... --out DIR [--views 3] [--seeds 3] [--iterations 900] [--max-size N]
                      [--rows none,warp,...] [--arm NAME[@PROGRAM]="ARGS"] [--base none] [--common "ARGS"]
                      [--truth auto|trace|model] [--jobs N] [--build build] [--tables]
    bench/headroom.py --quick --out DIR     a small scene that it makes, one seed: 25 s of CPU time

Each row is `gsfix fix SCENE --views K --seed S` with another restorer, path or schedule:

    none         no repair
    warp         the restorer warp
    warp8        the same restorer, called through 8-bit files, so that its frames can be measured
    carried      colours of the photos, carried over with the true depth; confidence 1 where a photo sees the surface
    masked       the truth where warp reaches, with warp's confidence
    blurred      the truth everywhere, blurred by a Gaussian of --sigma pixels
    seen         the truth where a photo sees the surface
    truth        the truth everywhere: the oracle. The other rows convert a share of its gain
    densify      the oracle, with densification until the last step
    ellipse      the oracle on the path `ellipse`
    interpolate  the oracle on the path `interpolate`
    capture      the oracle at the capture's other cameras, neither trained on nor held out

Where the restored frames have no confidence they are not trained on. --arm adds a row; in its ARGS, `--restorer oracle:ROW`
stands for the oracle of the row warp, carried, masked, blurred, seen or truth: --arm far="--restorer oracle:truth --path
far.json". PROGRAM is another build of gsfix. --base is the row whose figures gains, also the oracle's, are counted from: with
--arm v010@OLD/gsfix="--restorer none" --base v010 the share is that of the way from version 0.1.0 without repair to the oracle
of today. --common adds arguments to all rows; where both have --set, the row's settings come last.

For a scene of make_scene the truth is ray-traced (--truth trace). For any other it is rendered from a model trained on all
photos except the held-out ones, for --model-iterations steps (--truth model). A pixel is seen if its surface point is at
most 1.02 (ray-traced) or 1.05 times (model) as deep in one of the training photos as the surface there.

A run that has left its result.json is not repeated, so an interrupted call can be continued. DIR/headroom.csv has one row
per run. DIR/headroom.md, also printed, has three tables per scene: PSNR of the rows on the held-out views, with gains over
the base paired by seed and their standard errors; the frames of each round against the truth; and how far held-out views
are from each path. With several scenes the means over them follow. --tables only writes the tables of the runs there are.
Needs only the standard library.
"""
import argparse
import collections
import concurrent.futures
import csv
import functools
import hashlib
import json
import math
import os
import shlex
import shutil
import sys
import threading

import runs
from runs import mean_and_error, read_json, write_json

ROWS = [
    ("none", "--restorer none"),
    ("warp", "--restorer warp"),
    ("warp8", "--restorer oracle:warp"),
    ("carried", "--restorer oracle:carried"),
    ("masked", "--restorer oracle:masked"),
    ("blurred", "--restorer oracle:blurred"),
    ("seen", "--restorer oracle:seen"),
    ("truth", "--restorer oracle:truth"),
    ("densify", "--restorer oracle:truth --set densify_until={iterations}"),
    ("ellipse", "--restorer oracle:truth --trajectory ellipse"),
    ("interpolate", "--restorer oracle:truth --trajectory interpolate"),
    ("capture", "--restorer oracle:truth --path {capture} --set windows={windows},window_frames={window_frames}"),
]
FIGURES = ("psnr", "psnr_seen", "psnr_unseen", "ssim", "ssim_seen")
GAINS = ("psnr", "psnr_seen", "psnr_unseen")
QUICK_SCENE = "--views 16 --width 64 --height 48 --points 2000"
QUICK_SETTINGS = "--set rounds=2,windows=2,window_frames=9"
MOST_FRAMES = 17  # of a window, by default
FAR = "1000"      # depth of the sky of make_scene's courtyard

FRAMES_TEXT = ("Frames against the truth, PSNR in dB: rendered and restored, over all pixels and over those with "
               "confidence; share of pixels with confidence, share that a photo sees, mean confidence where there is any:")
PATHS_TEXT = ("Held-out views and the path: distance to the nearest frame, in diameters of the capture; angle to the frame "
              "nearest in direction, in degrees:")

Scene = collections.namedtuple("Scene", "name folder out made")
run = functools.partial(runs.run, OMP_NUM_THREADS="1")


def decibels(error):
    return -10.0 * math.log10(error) if error > 0.0 else float("inf")


# ---- cameras -------------------------------------------------------------------------

def read_cameras(path):
    return read_json(path)["cameras"]


def center_of(camera):
    m = camera["w2c"]  # row-major
    return [-sum(m[4 * r + c] * m[4 * r + 3] for r in range(3)) for c in range(3)]


def forward_of(camera):
    return camera["w2c"][8:11]


def distance(a, b):
    return math.sqrt(sum((x - y) ** 2 for x, y in zip(a, b)))


def degrees(a, b):
    cosine = sum(x * y for x, y in zip(a, b)) / (distance(a, (0, 0, 0)) * distance(b, (0, 0, 0)))
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))


def path_distances(views, frames, diameter):
    """Of each view: to the nearest frame, as a share of the capture's diameter; to the axis nearest in direction."""
    found = []
    for camera in views:
        center, forward = center_of(camera), forward_of(camera)
        found.append((min(distance(center, frame["center"]) for frame in frames) / diameter,
                      min(degrees(forward, frame["forward"]) for frame in frames)))
    return found


# ---- truth ---------------------------------------------------------------------------

def render_truth(config, cameras, out):
    """Truth at the cameras of a file, whole or not at all."""
    if os.path.isdir(out):
        return
    part = "%s.part%d" % (out, os.getpid())
    shutil.rmtree(part, ignore_errors=True)
    os.makedirs(os.path.dirname(out), exist_ok=True)
    if config["made"]:
        run([config["make_scene"], config["scene"], "--render", cameras, "--out", part])
    else:
        run([config["oracle"], "render", config["model"], cameras, part, "--near", str(config["near"])])
    try:
        os.rename(part, out)
    except OSError:  # another run has made it meanwhile
        shutil.rmtree(part)


def restore(config_path, job):
    """Restores one window; called by `gsfix fix --restorer exec:`."""
    config = read_json(config_path)
    cameras = read_cameras(os.path.join(job, "cameras.json"))
    for camera in cameras:
        camera.pop("name", None)
    name = hashlib.sha256(json.dumps(cameras).encode()).hexdigest()[:32]
    truth = os.path.join(config["cache"], name)
    render_truth(config, os.path.join(job, "cameras.json"), truth)
    text, _ = run([config["oracle"], "restore", config["row"], job, truth, config["photo_truth"]] + config["flags"])
    log = []
    if os.path.exists(config["log"]):
        with open(config["log"]) as file:
            log = [json.loads(line) for line in file]
    mark = os.path.join(job, "window")  # a job folder serves one round, whose first window finds no mark
    is_next = os.path.exists(mark)
    open(mark, "w").close()
    last = log[-1]["round"] if log else 0
    frames = [{"center": center_of(camera), "forward": forward_of(camera)} for camera in cameras]
    with open(config["log"], "a") as file:
        window = {"round": last if is_next else last + 1, "sums": json.loads(text), "path": frames}
        file.write(json.dumps(window) + "\n")


# ---- preparation of a scene ------------------------------------------------------------

def size_of(options):
    return ["--max-size", str(options.max_size)] if options.max_size else []


def views_folder(scene, views):
    return os.path.join(scene.out, "K%s" % views)


def truth_config(options, scene):
    model = os.path.join(scene.out, "all")
    config = {"made": scene.made, "scene": os.path.abspath(scene.folder), "oracle": options.oracle,
              "make_scene": options.make_scene}
    if not scene.made:
        config.update(model=os.path.abspath(os.path.join(model, "splats.ply")),
                      near=read_json(os.path.join(model, "metrics.json"))["switches"]["near_plane"])
    return config


def check_settings(options, scene):
    """Checks that the settings shared by all rows are those with which the folder was begun."""
    path = os.path.join(scene.out, "settings.json")
    settings = {"scene": os.path.abspath(scene.folder), "made": scene.made, "iterations": options.iterations,
                "max_size": options.max_size, "sigma": options.sigma, "common": options.common,
                "model_iterations": None if scene.made else options.model_iterations}
    was = read_json(path)
    if was and was != settings:
        sys.exit("%s: begun with other settings (choose a new --out): %s" % (path, was))
    write_json(path, settings)


def prepare_scene(options, scene):
    os.makedirs(scene.out, exist_ok=True)
    check_settings(options, scene)
    cameras = os.path.join(scene.out, "cameras.json")
    run([options.oracle, "cameras", scene.folder, cameras + ".part"] + size_of(options))
    os.rename(cameras + ".part", cameras)
    model = os.path.join(scene.out, "all")
    if scene.made or os.path.exists(os.path.join(model, "done.json")):
        return
    run([options.gsfix, "fix", scene.folder, "--out", model, "--restart", "--views", "all", "--restorer", "none",
         "--regularize", "off", "--seed", "1", "--iterations", str(options.model_iterations),
         "--threads", str(options.jobs)] + size_of(options))
    write_json(os.path.join(model, "done.json"), {})


def write_made_masks(options, config, folder, names):
    """Masks of the held-out views by ray-traced truth; the share that is seen of each."""
    masks, truth = os.path.join(folder, "masks"), os.path.join(folder, "test_truth")
    render_truth(config, os.path.join(folder, "test.json"), truth)
    text, _ = run([options.oracle, "masks", os.path.join(folder, "test.json"), truth,
                   os.path.join(folder, "photos.json"), os.path.join(folder, "photo_truth"), masks] + flags_of(config))
    for i, name in enumerate(names):
        os.rename(os.path.join(masks, "%05d.png" % i), os.path.join(masks, os.path.splitext(name)[0] + ".png"))
    return json.loads(text)["seen"]


def write_model_masks(options, scene, config, folder, views, names):
    text, _ = run([options.gsfix, "masks", scene.folder, "--views", views, "--model", config["model"], "--out",
                   os.path.join(folder, "masks"), "--json"] + size_of(options))
    shares = {row["name"]: row["seen"] for row in json.loads(text)["per_view"]}
    return [shares[name] for name in names]


def prepare_views(options, scene, views):
    folder = views_folder(scene, views)
    if os.path.exists(os.path.join(folder, "split.json")):
        return
    shutil.rmtree(os.path.join(folder, "masks"), ignore_errors=True)
    os.makedirs(folder, exist_ok=True)
    split = json.loads(run([options.gsfix, "info", scene.folder, "--views", views, "--json"] + size_of(options))[0])
    by_name = {camera["name"]: camera for camera in read_cameras(os.path.join(scene.out, "cameras.json"))}
    used = set(split["train"]) | set(split["test"])
    others = [name for name in by_name if name not in used]
    for file, names in (("photos", split["train"]), ("test", split["test"]), ("capture", others)):
        write_json(os.path.join(folder, file + ".json"), {"cameras": [by_name[name] for name in names]})
    config = truth_config(options, scene)
    render_truth(config, os.path.join(folder, "photos.json"), os.path.join(folder, "photo_truth"))
    if scene.made:
        seen = write_made_masks(options, config, folder, split["test"])
    else:
        seen = write_model_masks(options, scene, config, folder, views, split["test"])
    centers = [center_of(camera) for camera in by_name.values()]
    write_json(os.path.join(folder, "split.json"), {
        "seen": dict(zip(split["test"], seen)), "train": len(split["train"]), "others": len(others),
        "diameter": max(distance(a, b) for a in centers for b in centers)})


# ---- the runs ------------------------------------------------------------------------

def flags_of(config):
    if config["made"]:
        return ["--tolerance", "0.02", "--far", FAR]
    return ["--tolerance", "0.05"]


def job_folder(job):
    scene, views, row, seed = job
    return os.path.join(views_folder(scene, views), "rows", row, "seed%d" % seed)


def result_of(job):
    return read_json(os.path.join(job_folder(job), "result.json"))


def united(arguments):
    """The arguments with one --set of all."""
    rest, settings = [], []
    at = iter(arguments)
    for argument in at:
        if argument == "--set":
            settings.append(next(at))
        else:
            rest.append(argument)
    return rest + (["--set", ",".join(settings)] if settings else [])


def setting_of(arguments, name):
    """Value that --set gives a setting, or None."""
    found = None
    for settings, value in zip(arguments, arguments[1:]):
        for pair in value.split(",") if settings == "--set" else []:
            key, _, number = pair.partition("=")
            found = number if key == name else found
    return found


def arguments_of(options, job, arm, config_path):
    scene, views, _, _ = job
    folder = views_folder(scene, views)
    split = read_json(os.path.join(folder, "split.json"))
    common = shlex.split(options.common)
    windows = int(setting_of(common, "windows") or max(2, split["train"]))
    frames = max(3, min(MOST_FRAMES, -(-split["others"] // windows)))  # enough for all cameras of the capture, if possible
    arm = shlex.split(arm.format(iterations=options.iterations, capture=os.path.join(folder, "capture.json"),
                                 windows=windows, window_frames=frames))
    oracle = [argument[len("oracle:"):] for argument in arm if argument.startswith("oracle:")]
    program = "exec:" + shlex.join([sys.executable, os.path.abspath(__file__), "--restore", config_path])
    arm = [program if argument.startswith("oracle:") else argument for argument in arm]
    return united(common + arm), oracle[0] if oracle else None


def unseen_psnr(metrics, shares):
    """Mean over the views of what all pixels less the seen ones give; None where photos are masked."""
    values = []
    for view in metrics["per_view"]:
        share = shares[view["name"]]
        if metrics["switches"]["photos_masked"] or share > 0.999 or view["psnr"] is None:
            continue
        error = 10.0 ** (-view["psnr"] / 10.0)
        if view["psnr_seen"] is not None:
            error -= share * 10.0 ** (-view["psnr_seen"] / 10.0)
        values.append(decibels(error / (1.0 - share)))
    return sum(values) / len(values) if values else None


def rounds_of(log):
    """Sums of each round's windows."""
    rounds = {}
    for window in log:
        sums = rounds.setdefault(window["round"], collections.Counter())
        sums.update(window["sums"])
    return [dict(rounds[key]) for key in sorted(rounds)]


def fix(options, job, arm, program):
    scene, views, _, seed = job
    folder, out = views_folder(scene, views), job_folder(job)
    split = read_json(os.path.join(folder, "split.json"))
    config_path, log_path = (os.path.abspath(os.path.join(out, name)) for name in ("config.json", "windows.jsonl"))
    arguments, oracle = arguments_of(options, job, arm, config_path)
    config = truth_config(options, scene)
    config.update(row=oracle, log=log_path, photo_truth=os.path.abspath(os.path.join(folder, "photo_truth")),
                  cache=os.path.abspath(cache_of(job)), flags=flags_of(config) + ["--sigma", str(options.sigma)])
    write_json(config_path, config)
    command = [program or options.gsfix, "fix", scene.folder, "--out", os.path.join(out, "run"), "--restart", "--views", views,
               "--seed", str(seed), "--threads", "1", "--iterations", str(options.iterations),
               "--masks", os.path.join(folder, "masks")]
    _, cpu = run(command + size_of(options) + arguments)
    metrics = read_json(os.path.join(out, "run", "metrics.json"))
    row = {figure: metrics.get(figure) for figure in FIGURES}
    row.update(psnr_unseen=unseen_psnr(metrics, split["seen"]), splats=metrics["splats"], cpu_seconds=cpu, arguments=arm,
               program=program)
    if os.path.exists(log_path):  # else all windows were skipped, or no oracle was used
        with open(log_path) as file:
            log = [json.loads(line) for line in file]
        frames = [frame for window in log for frame in window["path"]]
        row.update(rounds=rounds_of(log),
                   distances=path_distances(read_cameras(os.path.join(folder, "test.json")), frames, split["diameter"]))
    return row


def cache_of(job):
    scene, views, _, seed = job
    return os.path.join(views_folder(scene, views), "truth_on_paths", "seed%d" % seed)


def work(options, job, arm, program):
    out, done = job_folder(job), result_of(job)
    if done and (done["arguments"], done.get("program")) != (arm, program):
        sys.exit("%s: made with other arguments: %s %s" % (out, done.get("program") or "", done["arguments"]))
    if not done:
        shutil.rmtree(out, ignore_errors=True)  # left by a stopped call
        os.makedirs(out)
        write_json(os.path.join(out, "result.json"), fix(options, job, arm, program))
        if not options.keep:
            shutil.rmtree(os.path.join(out, "run"))
    return result_of(job)


# ---- the tables ----------------------------------------------------------------------

def gains_of(rows, base, figure):
    """Differences to a row of the same seed."""
    return [row[figure] - base[seed][figure] for seed, row in sorted(rows.items())
            if seed in base and None not in (row[figure], base[seed][figure])]


def mean_of(rows, figure):
    return mean_and_error([row[figure] for row in rows.values() if row[figure] is not None])[0]


def number(value, form="%.2f"):
    return form % value if math.isfinite(value) else "-"


def with_error(mean, error, form="%+.2f"):
    return number(mean, form) + (" +- %.2f" % error if math.isfinite(error) else "")


def share(gain, whole):
    return "%.0f %%" % (100.0 * gain / whole) if math.isfinite(gain) and math.isfinite(whole) and whole > 0.0 else "-"


def figure_lines(found, arms, base):
    lines = ["| row | PSNR | seen | unseen | gain | gain seen | gain unseen | of the oracle's | seen | runs |",
             "|---|---|---|---|---|---|---|---|---|---|"]
    whole = {f: mean_and_error(gains_of(found.get("truth", {}), found.get(base, {}), f))[0] for f in GAINS}
    for arm in arms:
        rows = found.get(arm)
        if not rows:
            continue
        gains = {f: mean_and_error(gains_of(rows, found.get(base, {}), f)) for f in GAINS}
        cells = [number(mean_of(rows, f)) for f in GAINS]
        cells += ["" if arm == base else with_error(*gains[f]) for f in GAINS]
        cells += ["" if arm == base else share(gains[f][0], whole[f]) for f in GAINS[:2]]
        lines.append("| %s | %s | %d |" % (arm, " | ".join(cells), len(rows)))
    return lines


def round_cells(sums):
    """Table cells of a round, from its sums over windows and seeds."""
    pixels, reached = sums["pixels"], sums["reached"]
    psnr = [decibels(sums[key] / pixels) for key in ("render_error", "restored_error")]
    psnr += [decibels(sums[key] / reached) if reached else float("nan")
             for key in ("reached_render_error", "reached_restored_error")]
    shares = [reached / pixels, sums["seen"] / pixels]
    return ([number(x) if x != float("inf") else "exact" for x in psnr] + ["%.0f %%" % (100.0 * x) for x in shares] +
            [number(sums["confidence"] / reached if reached else float("nan"))])


def frame_lines(found, arms):
    lines = ["| row | round | render | restored | render, reached | restored, reached | reached | seen | confidence |",
             "|---|---|---|---|---|---|---|---|---|"]
    for arm in arms:
        done = [row["rounds"] for row in found.get(arm, {}).values() if row.get("rounds")]
        for k in range(max((len(rounds) for rounds in done), default=0)):
            sums = collections.Counter()
            for rounds in done:
                sums.update(rounds[k] if k < len(rounds) else {})
            if sums["pixels"]:
                lines.append("| %s | %d | %s |" % (arm, k + 1, " | ".join(round_cells(sums))))
    return lines


def path_name(arm, arguments):
    words = shlex.split(arguments)
    if "--path" in words:
        return arm
    return words[words.index("--trajectory") + 1] if "--trajectory" in words else "reference"


def path_lines(found, arms):
    lines = ["| path | distance, mean | largest | degrees, mean | largest |",
             "|---|---|---|---|---|"]
    paths = {}
    for arm, (arguments, _) in arms.items():
        for row in found.get(arm, {}).values():
            if row.get("distances"):
                paths.setdefault(path_name(arm, arguments), {}).setdefault(arm, []).extend(row["distances"])
    for name, by_arm in paths.items():
        values = next(iter(by_arm.values()))  # the same for all rows of a path
        columns = list(zip(*values))
        lines.append("| %s | %s |" % (name, " | ".join(form % x for column, form in zip(columns, ("%.2f", "%.1f"))
                                                      for x in (sum(column) / len(column), max(column)))))
    return lines


def scene_means(by_scene, arms, base):
    """Gains averaged over the scenes, and of the shares of the means."""
    lines = ["| row | gain | gain seen | gain unseen | of the oracle's | seen | scenes |",
             "|---|---|---|---|---|---|---|"]
    gains = {arm: {f: [] for f in GAINS} for arm in arms}
    for found in by_scene:
        for arm in arms:
            for f in GAINS:
                mean = mean_and_error(gains_of(found.get(arm, {}), found.get(base, {}), f))[0]
                if math.isfinite(mean):
                    gains[arm][f].append(mean)
    whole = {f: mean_and_error(gains["truth"][f])[0] if "truth" in gains else float("nan") for f in GAINS}
    for arm in arms:
        if arm == base or not gains[arm]["psnr"]:
            continue
        means = {f: mean_and_error(gains[arm][f]) for f in GAINS}
        complete = "truth" in gains and len(gains[arm]["psnr"]) == len(gains["truth"]["psnr"])
        shares = [share(means[f][0], whole[f]) if complete else "-" for f in GAINS[:2]]
        cells = [with_error(*means[f]) for f in GAINS] + shares
        lines.append("| %s | %s | %d |" % (arm, " | ".join(cells), len(gains[arm]["psnr"])))
    return lines


def write_tables(options, scenes):
    lines, by_views, arms, base = [], {}, options.arms, options.base
    with open(os.path.join(options.out, "headroom.csv"), "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("scene", "views", "row", "seed") + FIGURES + ("splats", "cpu_seconds"))
        for scene in scenes:
            for views in options.views:
                found = {}
                for arm in arms:
                    for seed in options.seeds:
                        row = result_of((scene, views, arm, seed))
                        if row:
                            found.setdefault(arm, {})[seed] = row
                            table.writerow([scene.name, views, arm, seed] +
                                           [row[f] for f in FIGURES + ("splats", "cpu_seconds")])
                if not found:
                    continue
                by_views.setdefault(views, []).append(found)
                lines += ["### %s, %s photos" % (scene.name, views), ""] + figure_lines(found, arms, base)
                lines += ["", FRAMES_TEXT, ""] + frame_lines(found, arms)
                lines += ["", PATHS_TEXT, ""] + path_lines(found, arms) + [""]
    for views, found in by_views.items():
        if len(found) > 1:
            lines += ["### Means over the scenes, %s photos" % views, ""] + scene_means(found, arms, base) + [""]
    text = "\n".join(lines)
    with open(os.path.join(options.out, "headroom.md"), "w") as file:
        file.write(text)
    return text


# ---- the command ---------------------------------------------------------------------

def read_options():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE")
    parser.add_argument("--out", required=True)
    parser.add_argument("--build", default="build")
    parser.add_argument("--views", default="3")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--iterations", type=int, default=900)
    parser.add_argument("--model-iterations", type=int, default=3000)
    parser.add_argument("--max-size", type=int, default=0)
    parser.add_argument("--sigma", type=float, default=2.0)
    parser.add_argument("--rows", default=",".join(name for name, _ in ROWS))
    parser.add_argument("--arm", action="append", default=[])
    parser.add_argument("--base", default="none")
    parser.add_argument("--common", default="")
    parser.add_argument("--truth", choices=("auto", "trace", "model"), default="auto")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--keep", action="store_true", help="keep what gsfix fix wrote, and the truth")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--tables", action="store_true")
    options = parser.parse_args()
    if bool(options.scenes) == options.quick:
        parser.error("either scenes or --quick")
    known = dict(ROWS)
    rows = options.rows.split(",")
    unknown = [row for row in rows if row not in known]
    if unknown:
        parser.error("no row " + unknown[0])
    options.views = options.views.split(",")
    for program in ("gsfix", "oracle", "make_scene"):
        setattr(options, program, os.path.abspath(os.path.join(options.build, program)))
    options.arms = {row: (known[row], None) for row in rows}
    for text in options.arm:
        name, program, arguments = runs.split_arm(text)
        if "=" not in text or name in known:
            parser.error("--arm: expected a new NAME=\"ARGS\" or NAME@PROGRAM=\"ARGS\"")
        options.arms[name] = (arguments, os.path.abspath(program) if program else None)
    if options.base not in options.arms and options.base != "none":
        parser.error("--base: no row " + options.base)
    return options


def make_quick(options):
    scene = os.path.join(options.out, "quick")
    if not os.path.exists(os.path.join(scene, "truth", "scene.json")):
        run([options.make_scene, scene] + shlex.split(QUICK_SCENE))
    options.scenes, options.seeds, options.iterations = [scene], 1, 200
    options.common = QUICK_SETTINGS + " " + options.common


def scene_list(options):
    scenes = []
    for folder in options.scenes:
        name = os.path.basename(os.path.normpath(folder))
        if name in [scene.name for scene in scenes]:
            sys.exit("two scenes are called %s" % name)
        is_made = os.path.exists(os.path.join(folder, "truth", "scene.json"))
        if options.truth == "trace" and not is_made:
            sys.exit("%s: not of make_scene's making, its truth cannot be traced" % folder)
        out = os.path.join(options.out, "runs", name)
        scenes.append(Scene(name, folder, out, is_made and options.truth != "model"))
    return scenes


def run_all(options, scenes):
    """Scene by scene, seed by seed, so that the truth of a path is soon no longer needed."""
    left, lock = collections.Counter(), threading.Lock()
    jobs = [((scene, views, name, seed),) + arm for scene in scenes for views in options.views for seed in options.seeds
            for name, arm in options.arms.items()]
    for job, _, _ in jobs:
        left[cache_of(job)] += 1

    def one(job, arm, program):
        row = work(options, job, arm, program)
        with lock:
            left[cache_of(job)] -= 1
            if not left[cache_of(job)] and not options.keep:
                shutil.rmtree(cache_of(job), ignore_errors=True)
        return row

    for scene in scenes:
        prepare_scene(options, scene)
        for views in options.views:
            prepare_views(options, scene, views)
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        futures = {pool.submit(one, *job): job[0] for job in jobs}
        for future in concurrent.futures.as_completed(futures):
            scene, views, name, seed = futures[future]
            row = future.result()
            print("%s K=%s %-12s seed %d: psnr %.3f seen %.3f, %.1f CPU s" % (
                scene.name, views, name, seed, row["psnr"], row["psnr_seen"] or float("nan"), row["cpu_seconds"]),
                flush=True)
            write_tables(options, scenes)


def main():
    if len(sys.argv) == 4 and sys.argv[1] == "--restore":
        return restore(sys.argv[2], sys.argv[3])
    options = read_options()
    os.makedirs(options.out, exist_ok=True)
    if options.quick:
        make_quick(options)
    options.seeds = range(1, options.seeds + 1)
    scenes = scene_list(options)
    if not options.tables:
        run_all(options, scenes)
    print(write_tables(options, scenes))


if __name__ == "__main__":
    main()
