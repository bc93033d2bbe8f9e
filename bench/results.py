#!/usr/bin/env python3
"""Turns the output of bench_splat --json, bench_nn --json and bench_metrics --json into tables and charts.

    bench/results.py ROWS.jsonl DIR

Writes DIR/results.csv (every row), DIR/stages.svg (share of each stage in a training step, by size), DIR/growth.svg
(how run time scales), DIR/pipeline.svg (run time against error of the video model) and DIR/RESULTS.md. Several rows
with the same case, instruction set and thread count are rounds of one measurement; their median is reported. Rows of
test_stress --json go to the table of worst errors, rows of peers_nn.py and peers_metrics.py with a peer as variant to the
ratios, errors that the golden tests note (GSF_TEST_ERRORS) to the table of the metrics. Parts (splats,
networks, restorations, metrics) of which ROWS.jsonl has no row keep those of DIR/results.csv. Needs only the standard library.
"""
import collections
import csv
import json
import math
import os
import re
import statistics
import sys

COLUMNS = ["bench", "case", "variant", "isa", "threads", "seconds", "cpu_seconds", "work", "work_unit", "rate",
           "peak_share", "bytes", "bandwidth_share", "error_max", "error_rel_l2", "reference", "peak_rss_bytes", "ratio",
           "cpu_ratio", "peer", "rounds", "measured"]
TEXTS = ("bench", "case", "variant", "isa", "work_unit", "reference", "peer", "measured")
WINOGRAD = re.compile(r"conv3d|conv gradients|vae resnet")  # cases that count 9 products where 4 are made
STAGES = ["project", "bin", "sort", "blend", "loss", "reverse", "gather", "adam"]
COLORS = ["#8896ab", "#4477aa", "#66ccee", "#228833", "#ccbb44", "#ee6677", "#aa3377", "#bbbbbb"]


def short(value):  # three significant digits, never in exponent notation such as 1.14e+03
    return "%.3g" % value if value < 999.5 else "%.0f" % value


def ms(seconds):
    return short(1e3 * seconds)


def machine():
    try:
        with open("/proc/cpuinfo") as file:
            names = [line.split(":", 1)[1].strip() for line in file if line.startswith("model name")]
        return "%d x %s" % (len(names), names[0])
    except (OSError, IndexError):
        return "unknown processor"


def version():
    with open(os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "gsfixer.h")) as file:
        return next(line.split('"')[1] for line in file if line.startswith("#define GSF_VERSION "))


def measured():  # of which version the new rows are, and where they were measured
    return "version %s on %s" % (version(), machine())


def part_of(row):  # what is measured, and kept, together
    if row["case"].startswith(("pipeline: ", "model: ")):
        return "restorations"
    return {"splat": "splats", "nn": "networks"}.get(row["bench"], row["bench"])


def kept_rows(path, parts):  # those of an earlier run, except of these parts
    try:
        with open(path, newline="") as file:
            old = list(csv.DictReader(file))
    except OSError:
        return []
    return [{key: value if key in TEXTS else int(value) if value.isdigit() else float(value) for key, value in row.items() if value}
            for row in old if part_of(row) not in parts]


def medians(rows):
    groups = collections.OrderedDict()
    for row in rows:
        groups.setdefault((row["bench"], row["case"], row["variant"], row["isa"], row["threads"]), []).append(row)
    result = []
    for group in groups.values():
        row = dict(group[0])
        for key in ("seconds", "cpu_seconds", "rate", "peak_share", "bandwidth_share", "ratio", "cpu_ratio"):
            if key in row:
                row[key] = statistics.median(r[key] for r in group)
        row["rounds"] = len(group)
        result.append(row)
    return result


def write_csv(path, rows):
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)


def stages_of(rows):  # {(size, isa, threads): {stage: row}}
    result = collections.OrderedDict()
    for row in rows:
        size, colon, stage = row["case"].partition(": ")
        if colon and stage in STAGES:
            result.setdefault((size, row["isa"], row["threads"]), {})[stage] = row
    return result


def write_stages(path, rows):
    bars = [(key, stages) for key, stages in stages_of(rows).items() if len(stages) == len(STAGES)]
    left, width, bar, gap, top = 235, 535, 18, 8, 46
    height = top + len(bars) * (bar + gap) + 10
    out = ['<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 %d %d" font-family="sans-serif" font-size="12">'
           % (left + width + 90, height),
           '<rect width="100%" height="100%" fill="white"/>',
           '<text x="10" y="18" font-size="14">Share of each stage in a training step, and the whole step</text>']
    x = left
    for stage, color in zip(STAGES, COLORS):
        out.append('<rect x="%d" y="26" width="10" height="10" fill="%s"/><text x="%d" y="35">%s</text>'
                   % (x, color, x + 13, stage))
        x += 24 + 7 * len(stage)
    for i, ((size, isa, threads), stages) in enumerate(bars):
        y = top + i * (bar + gap)
        total = sum(stages[stage]["seconds"] for stage in STAGES)
        out.append('<text x="%d" y="%d" text-anchor="end">%s, %s, %d thread%s</text>'
                   % (left - 8, y + 13, size, isa, threads, "s" if threads > 1 else ""))
        x = float(left)
        for stage, color in zip(STAGES, COLORS):
            w = width * stages[stage]["seconds"] / total
            out.append('<rect x="%.1f" y="%d" width="%.1f" height="%d" fill="%s"/>' % (x, y, w, bar, color))
            x += w
        out.append('<text x="%d" y="%d">%s ms</text>' % (left + width + 8, y + 13, ms(total)))
    out.append("</svg>")
    with open(path, "w") as file:
        file.write("\n".join(out) + "\n")


GROWTH = [("splats", "splats, 960 x 540", COLORS[1]), ("pixels", "pixels, 100,000 splats", COLORS[5]),
          ("zoom", "magnification, 300,000 splats", COLORS[3])]


def growth_of(rows):  # {what grows: [(amount, seconds)]}
    result = {}
    for row in rows:
        if row["case"].startswith("growth: "):
            result.setdefault(row["work_unit"], []).append((row["work"], row["seconds"]))
    return result


def write_growth(path, rows):  # one log-log panel each; a decade has the same length in all of them
    growth = growth_of(rows)
    seconds = [s for line in growth.values() for _, s in line]
    if not seconds:
        return False
    low, high = math.floor(math.log10(min(seconds))), math.ceil(math.log10(max(seconds)))
    panel, decade, left, top = 60, 90, 60, 40
    height = top + decade * (high - low) + 50
    out, x0 = [], left
    for key, title, color in GROWTH:
        points = growth.get(key, [])
        first = math.floor(math.log10(points[0][0]))
        last = max(math.ceil(math.log10(points[-1][0])), first + 1)
        right, bottom = x0 + decade * (last - first), top + decade * (high - low)
        for e in range(low, high + 1):
            y = top + decade * (high - e)
            out.append('<line x1="%d" y1="%d" x2="%d" y2="%d" stroke="#ddd"/>' % (x0, y, right, y))
            out.append('<text x="%d" y="%d" text-anchor="end">%g ms</text>' % (x0 - 4, y + 4, 1e3 * 10.0 ** e))
        for e in range(first, last + 1):
            x = x0 + decade * (e - first)
            out.append('<line x1="%d" y1="%d" x2="%d" y2="%d" stroke="#ddd"/>' % (x, top, x, bottom))
            out.append('<text x="%d" y="%d" text-anchor="middle">%s</text>'
                       % (x, bottom + 16, "1e%d" % e if e > 2 else "%g" % 10 ** e))
        place = [(x0 + decade * (math.log10(a) - first), top + decade * (high - math.log10(s))) for a, s in points]
        out.append('<polyline points="%s" fill="none" stroke="%s" stroke-width="2"/>'
                   % (" ".join("%.1f,%.1f" % p for p in place), color))
        out += ['<circle cx="%.1f" cy="%.1f" r="3" fill="%s"/>' % (x, y, color) for x, y in place]
        out.append('<text x="%d" y="%d">by %s</text>' % (x0, top - 10, title))
        x0 += decade * (last - first) + panel + 20
    head = ['<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 %d %d" font-family="sans-serif" font-size="12">'
            % (x0, height), '<rect width="100%" height="100%" fill="white"/>',
            '<text x="10" y="16" font-size="14">Time of the forward and the backward pass together</text>']
    with open(path, "w") as file:
        file.write("\n".join(head + out + ["</svg>"]) + "\n")
    return True


def pipeline_of(rows, series):  # [(name, seconds, error)]
    return [(r["variant"], r["seconds"], r.get("error_rel_l2", 0.0)) for r in rows
            if r["bench"] == "nn" and r["case"].startswith("pipeline: " + series) and "converged" not in r["variant"]]


FAMILIES = [("ddim", COLORS[5]), ("dpmpp", COLORS[1]), ("unipc", COLORS[3]), ("guidance", COLORS[1]),
            ("no guidance", COLORS[1]), ("strength", COLORS[5]), ("block cache", COLORS[3]), ("", COLORS[6])]


def label_box(x, y, label, left, under):  # of 10 pixels' type, beside a point: left, top, right, bottom
    start, base = x - 6 - 6 * len(label) if left else x + 6, y + 12 if under else y - 5
    return start, base - 8, start + 6 * len(label), base + 2


def write_pipeline(path, rows):  # error (logarithmic) over seconds; one panel for steps, one for skips
    panels = [("Solvers and steps: error against the converged path", pipeline_of(rows, "steps")),
              ("Work skipped in 50 steps: error against the full run", pipeline_of(rows, "skips"))]
    if not all(points for _, points in panels):
        return False
    errors = [e for _, points in panels for _, _, e in points if e > 0.0]
    low, high = math.floor(math.log10(min(errors))), math.ceil(math.log10(max(errors)))
    longest = max(s for _, points in panels for _, s, _ in points)
    unit = 10.0 ** math.floor(math.log10(longest))
    unit *= 1 if longest / unit > 4 else 0.5
    decade, width, top, x0 = 380 // (high - low), 430, 60, 60
    bottom = top + decade * (high - low)
    scale = width / (math.ceil(longest / unit) * unit)
    out = []
    for title, points in panels:
        for e in range(low, high + 1):
            y = top + decade * (high - e)
            out.append('<line x1="%d" y1="%d" x2="%d" y2="%d" stroke="#ddd"/>' % (x0, y, x0 + width, y))
            out.append('<text x="%d" y="%d" text-anchor="end">%g</text>' % (x0 - 5, y + 4, 10.0 ** e))
        for k in range(int(math.ceil(longest / unit)) + 1):
            x = x0 + scale * k * unit
            out.append('<line x1="%.1f" y1="%d" x2="%.1f" y2="%d" stroke="#ddd"/>' % (x, top, x, bottom))
            out.append('<text x="%.1f" y="%d" text-anchor="middle">%g s</text>' % (x, bottom + 16, k * unit))
        out.append('<text x="%d" y="%d">%s</text>' % (x0, top - 12, title))
        lines, exact, taken = collections.OrderedDict(), [], []  # taken: boxes of labels, none over another
        for name, seconds, error in points:
            if error <= 0.0:
                exact.append("%s %s s" % (name, short(seconds)))
                continue
            family, color = next(f for f in FAMILIES if name.startswith(f[0]))
            lines.setdefault((family, color), []).append(
                (x0 + scale * seconds, top + decade * (high - math.log10(error)), name[len(family):].strip() or name))
        for k, ((family, color), line) in enumerate(lines.items()):
            if family:
                out.append('<polyline points="%s" fill="none" stroke="%s" stroke-opacity="0.5"/>'
                           % (" ".join("%.1f,%.1f" % p[:2] for p in line), color))
            for n, (x, y, label) in enumerate(line):
                out.append('<circle cx="%.1f" cy="%.1f" r="3.5" fill="%s"/>' % (x, y, color))
                below = (k if family else n) % 2 == 1  # preferred: labels of neighbouring lines on either side
                sides = sorted(((left, under) for left in (False, True) for under in (False, True)),
                               key=lambda side: (side != (below, below), side[0] != below))
                boxes = [label_box(x, y, label, left, under) for left, under in sides]
                free = [i for i, box in enumerate(boxes) if box[0] >= x0 and box[2] <= x0 + width + 12 and
                        not any(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken)]
                best = free[0] if free else 0
                taken.append(boxes[best])
                left, under = sides[best]
                out.append('<text x="%.1f" y="%.1f" font-size="10" text-anchor="%s" fill="%s">%s</text>'
                           % (x + (-6 if left else 6), y + (12 if under else -5), "end" if left else "start", color, label))
            out.append('<rect x="%d" y="%d" width="10" height="10" fill="%s"/><text x="%d" y="%d">%s</text>'
                       % (x0 + width + 12, top + 8 + 16 * k, color, x0 + width + 26, top + 17 + 16 * k,
                          family or "number formats"))
        for k in range(0, len(exact), 3):
            out.append('<text x="%d" y="%d" font-size="11">%s%s</text>'
                       % (x0, bottom + 36 + 14 * (k // 3), "" if k else "exact: ", ", ".join(exact[k:k + 3])))
        x0 += width + 190
    head = ['<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 %d %d" font-family="sans-serif" font-size="12">'
            % (x0 - 50, bottom + 70), '<rect width="100%" height="100%" fill="white"/>',
            '<text x="10" y="18" font-size="14">Relative L2 error of the restored frames over run time</text>']
    with open(path, "w") as file:
        file.write("\n".join(head + out + ["</svg>"]) + "\n")
    return True


def stress_rows(rows):  # the worst case of each test
    tests = collections.OrderedDict()
    for row in rows:
        tests.setdefault(row["test"], []).append(row)
    result = []
    for test, group in tests.items():
        cells = [test, str(len(group))]
        pixels, unclear = sum(r["pixels"] for r in group), sum(r["unclear"] for r in group)
        cells += ["%d" % pixels if pixels else "", "%.3f %%" % (100.0 * unclear / pixels) if pixels else ""]
        for key in ("clear_error", "unclear_error", "depth_error", "gradient"):
            values = [r[key] for r in group if r.get(key) is not None]
            cells.append("%.1e" % max(values) if values else "")
        known = ("test", "case", "level", "pixels", "unclear", "clear_error", "unclear_error", "depth_error", "gradient")
        others = {}
        for r in group:
            for key in r:
                if key not in known and r[key] is not None:
                    others[key] = max(r[key], others.get(key, r[key]))
        cells.append(", ".join("%s %.1e" % (k.replace("_", " "), v) for k, v in others.items()))
        result.append(cells)
    return result


def table(lines, head, rows):
    lines += ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    lines.append("")


def percent(row, key):
    return "%.0f %%" % (100.0 * row[key]) if key in row else ""


def splat_sections(lines, rows, stress, has_growth):
    peaks = [r for r in rows if r["case"].startswith("machine: ")]
    lines += ["## The machine", "",
              "Peaks measured by the bench itself: independent chains of multiply-adds, and the fastest of four sweeps over a "
              "buffer of the given size (read; read and write in place; copy through the caches; copy with streaming stores).", ""]
    table(lines, ["", "instructions", "threads", "per second"],
          [[r["case"][9:], r["isa"], str(r["threads"]), "%.1f G%s" % (1e-9 * r["rate"], r["work_unit"])] for r in peaks])
    lines += ["## Renders against double precision", "",
              "A pair is one splat blended into one pixel by the reference. Forward errors are those of the image, over pixels "
              "in which no binary decision is within 1e-4 of its threshold; backward errors are those of the gradient of the "
              "means.", ""]
    table(lines, ["", "instructions", "threads", "ms", "CPU ms", "M pairs/s", "largest error", "relative L2"],
          [[r["case"], r["isa"], str(r["threads"]), ms(r["seconds"]), ms(r["cpu_seconds"]),
            "%.0f" % (1e-6 * r["rate"]), "%.2g" % r["error_max"], "%.2g" % r["error_rel_l2"]]
           for r in rows if r["case"].startswith(("forward", "backward"))])
    lines += ["## Stages of a training step", "", "![Share of each stage](stages.svg)", "",
              "Shares are relative to the peaks above for the same instruction set and number of threads. Floating-point "
              "operations are counted from the kernels' source. Bytes are the minimum that each stage must transfer with cold "
              "caches, compared with a sweep over at most as much memory.", ""]
    table(lines, ["", "instructions", "threads", "ms", "CPU ms", "M/s", "FMA peak", "bandwidth"],
          [[r["case"], r["isa"], str(r["threads"]), ms(r["seconds"]), ms(r["cpu_seconds"]),
            "%s %s" % (short(1e-6 * r["rate"]), r["work_unit"]), percent(r, "peak_share"), percent(r, "bandwidth_share")]
           for r in rows if ": " in r["case"] and not r["case"].startswith(("machine", "visibility", "growth", "lazy", "skip"))])
    skips = [r for r in rows if r["case"].startswith(("skip: ", "lazy: "))]
    if skips:
        lines += ["## Skipped work: savings and error", "",
                  "Forward and backward passes: the default; splats drawn only in the tiles of their 3-sigma square, like the "
                  "rasterizer of Inria's 3DGS (for comparison; not used elsewhere); splats in arbitrary order (all other rows use "
                  "the Morton order of `gsf_splat_sort`). The difference is that of the image from the default's.", "",
                  "Lazy Adam: the SH of blocks of splats that are not visible in a step are not updated, and catch up when a "
                  "splat of the block is drawn again (off by default; turned on by `lazy_adam` and `--quality fast`). Steps "
                  "alternate between five views; catching up counts as part of the step, not of its Adam stage. The difference "
                  "is that of the SH from those of the dense run, including rounding fed back through all steps: the largest, "
                  "relative to at least 0.2, and in L2. With prescribed gradients it is 4.7e-7 after 1,000 steps "
                  "(`tests/test_trainer.c`).", "",
                  "For skipped windows and the three values of `--quality`, see QUALITY.md.", ""]
        table(lines, ["", "", "threads", "ms", "CPU ms", "largest difference", "relative L2"],
              [[r["case"][6:], r["variant"], str(r["threads"]), ms(r["seconds"]),
                ms(r["cpu_seconds"]), "%.1e" % r["error_max"] if "error_max" in r else "",
                "%.1e" % r["error_rel_l2"] if "error_rel_l2" in r else ""] for r in skips])
    if has_growth:
        lines += ["## Scaling", "", "![Seconds by splats, by pixels and by magnification](growth.svg)", "",
                  "Splats shrink as their number grows, so that the number that overlaps a pixel stays about the same; under "
                  "magnification, fewer of the same splats are in the frame. All axes are logarithmic with decades of equal "
                  "length.", ""]
    filters = [r for r in rows if r["case"].startswith("visibility")]
    if filters:
        lines += ["## Visible-point filter", ""]
        table(lines, ["", "by", "threads", "seconds", "M/s"],
              [[r["case"][11:], r["variant"], str(r["threads"]), short(r["seconds"]),
                "%s %s" % (short(1e-6 * r["rate"]), r["work_unit"])] for r in filters])
    steps = [r for r in rows if r["case"] == "train step"]
    if steps:
        lines += ["## Training steps on photos", "",
                  "Render, loss, gradients and Adam with density control off; medians of %d alternating rounds."
                  % max(int(r.get("rounds", 1)) for r in steps), ""]
        table(lines, ["", "threads", "ms", "CPU ms", "peak memory"],
              [["ours, " + r["isa"] if r["variant"] == "default" else r["variant"], str(r["threads"]),
                "%.4g" % (1e3 * r["seconds"]), "%.4g" % (1e3 * r["cpu_seconds"]),
                "%.0f MiB" % (r["peak_rss_bytes"] / 2**20) if "peak_rss_bytes" in r else ""] for r in steps])
        ours = [r for r in steps if r["variant"] == "default"]
        for peer in (r for r in steps if r["variant"] != "default"):
            lines += ["%s takes %.1f times the time, %.1f times the CPU time and %.1f times the memory."
                      % (peer["variant"], peer["seconds"] / ours[0]["seconds"],
                         peer["cpu_seconds"] / ours[0]["cpu_seconds"],
                         peer["peak_rss_bytes"] / ours[0]["peak_rss_bytes"]), ""]
    if stress:
        lines += ["## Worst errors of the stress suite", "",
                  "`tests/test_stress.c` against double precision, for every instruction set of this machine. A pixel is "
                  "ambiguous if a binary decision of the reference (alpha = 1/255 and 0.99, T = 1e-4) is within a relative "
                  "1e-4 of its threshold, or if two splats are within 1e-6 of each other in depth. Colours lie between 0 and "
                  "1; gradients are in relative L2 under the same decisions. Limits for ordinary scenes: 2e-5 for clear "
                  "pixels, 8e-3 for ambiguous ones, 2e-4 for gradients; harder scenes have limits of their own in the test.", ""]
        table(lines, ["", "cases", "pixels", "ambiguous", "largest error, clear", "ambiguous", "depth, relative", "gradient",
                      "other"],
              stress_rows(stress))


def errors(row):
    return ["%.1e" % row[key] if key in row else "" for key in ("error_max", "error_rel_l2")]


def nn_sections(lines, rows, has_pipeline):
    def peer(row):  # the key that a row shares with its peers
        return row["case"], row["isa"], row["threads"], row["variant"].replace(" products", "").endswith("bf16")

    ratios = collections.defaultdict(list)
    for r in sorted((r for r in rows if "ratio" in r), key=lambda r: r["ratio"]):
        ratios[peer(r)].append("%.2f %s" % (r["ratio"], r["variant"].replace(" bf16", "")))
    peaks = [r for r in rows if r["case"].startswith("machine: ")]
    kernels = [r for r in rows if "ratio" not in r and not r["case"].startswith(("machine: ", "pipeline: ", "model: "))]
    lines += ["## Kernels of the video model and its encoders", "",
              "Peaks measured in the same run: independent chains of multiply-adds, integer dot products (8-bit where there are "
              "instructions for them, else 16-bit) and bf16 dot products, sweeps over memory as above.", ""]
    table(lines, ["", "instructions", "threads", "per second"],
          [[r["case"][9:], r["isa"], str(r["threads"]), "%.1f G%s" % (1e-9 * r["rate"], r["work_unit"])] for r in peaks])
    lines += ["Sizes are those of the released model; the smallest cases are measured with every instruction set. Shares are "
              "relative to the peaks above: of 8-bit layers to the integer peak, of bf16 products to the bf16 peak, of all "
              "others to the multiply-add peak. Convolutions by 3 x 3 and their gradients count the products of a direct sum, of "
              "which Winograd's algorithm needs 4 of 9, so that their share can exceed 100 %. Bandwidth is relative to a sweep "
              "over as much memory or, where GEMV cases cycle through 1 GiB of weights, to reading it between rounds. Errors are "
              "relative to sums in double precision, those of layers of the encoders to the same with products of float32. The last "
              "column is the peers' time divided by ours, timed alternately in the same run (`bench/peers_nn.py`), "
              "fastest first: PyTorch in its default configuration, PyTorch with oneDNN's linear layers on prepacked weights, "
              "and OpenBLAS; in float32, or in bf16 where our products are in bf16. 8-bit layers include the quantization of "
              "their input, except for the rows of oneDNN's product alone. PyTorch reuses the memory of its results here; "
              "allocating fresh pages for every large result would make it up to five times slower.", ""]
    table(lines, ["", "", "instructions", "threads", "ms", "CPU ms", "peak", "bandwidth", "largest error", "relative L2",
                  "peers / ours"],
          [[r["case"], "" if r["variant"] == "default" else r["variant"], r["isa"], str(r["threads"]), ms(r["seconds"]),
            ms(r["cpu_seconds"]), percent(r, "peak_share"), percent(r, "bandwidth_share")] + errors(r)
           + [", ".join(ratios[peer(r)])]
           for r in kernels])
    if has_pipeline:
        lines += ["## A whole restoration: run time against error", "", "![Error over run time](pipeline.svg)", "",
                  "A clip of 9 frames through a model with random weights (`make_model --size small`), encoder and decoder "
                  "included. Its velocity field is not that of a trained model: the figures show what each option costs and "
                  "how the errors rank, not how restored frames look. With a strength below 1, the clip starts from the noised "
                  "render instead of pure noise; it then converges to a different result, so the difference is not an error.", ""]
        table(lines, ["", "", "seconds", "CPU seconds", "largest error", "relative L2", "against"],
              [[r["case"][10:], r["variant"], short(r["seconds"]), short(r["cpu_seconds"])] + errors(r)
               + [r["reference"] if "error_max" in r else ""] for r in rows if r["case"].startswith("pipeline: ")])
    models = [r for r in rows if r["case"].startswith("model: ")]
    if models:
        lines += ["## The released size", "",
                  "Random weights in the layout of the GSFixer release (`make_model --size full`), 49 frames of 720 x 480: "
                  "17,550 video and 226 text tokens, 1,850 reference tokens. Memory excludes the weights, which are "
                  "memory-mapped.", ""]
        table(lines, ["", "", "instructions", "threads", "seconds", "CPU seconds", "TFLOP", "FMA peak", "peak memory"],
              [[r["case"][7:], "" if r["variant"] == "default" else r["variant"], r["isa"], str(r["threads"]),
                short(r["seconds"]), short(r["cpu_seconds"]), short(1e-12 * r["work"]),
                percent(r, "peak_share"), "%.2f GiB" % (r["peak_rss_bytes"] / 2**30)] for r in models])


def metric_sections(lines, rows, noted):
    worst = {}
    for row in noted:
        worst[row["error_of"]] = max(row["error"], worst.get(row["error_of"], 0.0))
    peers = {(r["case"], r["threads"]): r for r in rows if "ratio" in r}
    lines += ["## Metrics: run time and error", "",
              "A clip of 720 x 480 with as many frames as N says, frame by frame; networks at their real sizes with random "
              "weights, which are read before. Errors are the largest against double precision in `golden_metrics` and "
              "`golden_metricnets`: relative for LPIPS, in decibels for PSNR, of the score (0 to 1) for all others. The peer's "
              "time divided by ours, with its CPU time divided by ours in brackets, is that of the same run "
              "(`bench/peers_metrics.py` says what runs as a peer of each). Memory is the peak of the process so far.", ""]
    body = []
    for r in rows:
        if "ratio" in r:
            continue
        name, _, frames = r["case"].partition(" 720x480 ")
        peer = peers.get((r["case"], r["threads"]))
        body.append([name, frames, r["isa"], str(r["threads"]), short(r["seconds"]), short(r["cpu_seconds"]),
                     "%.0f MiB" % (r["peak_rss_bytes"] / 2**20), "%.1e" % worst[name] if name in worst else "",
                     "%.2f (%.2f) %s" % (peer["ratio"], peer["cpu_ratio"], peer["variant"]) if peer else ""])
    table(lines, ["", "frames", "instructions", "threads", "seconds", "CPU seconds", "peak memory", "largest error",
                  "peer / ours"], body)


def write_markdown(path, rows, stress, noted, has_growth, has_pipeline):
    runs = sorted({"%s: %s" % (part_of(r), r["measured"]) for r in rows})
    lines = ["# Speed and error", "",
             "Measured by `bench/run.sh`; %s. The machine may have run other work at the same time: compare rows within one "
             "run, not between runs." % "; ".join(runs), ""]
    splat_sections(lines, [r for r in rows if r["bench"] not in ("nn", "metrics")], stress, has_growth)
    if any(r["bench"] == "nn" for r in rows):
        nn_sections(lines, [r for r in rows if r["bench"] == "nn"], has_pipeline)
    if any(r["bench"] == "metrics" for r in rows):
        metric_sections(lines, [r for r in rows if r["bench"] == "metrics"], noted)
    with open(path, "w") as file:
        file.write("\n".join(lines).rstrip() + "\n")


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    with open(sys.argv[1]) as file:
        all_rows = [json.loads(line) for line in file if line.startswith("{")]
    if not all_rows:
        sys.exit("results: no rows in " + sys.argv[1])
    rows = medians([row for row in all_rows if "bench" in row])
    if all(row["case"].startswith("machine: ") for row in rows if part_of(row) == "networks"):
        rows = [row for row in rows if part_of(row) != "networks"]  # bench_nn measures peaks for restorations, too
    for row in rows:
        row["measured"] = measured()
    table_path = os.path.join(sys.argv[2], "results.csv")
    rows += kept_rows(table_path, {part_of(row) for row in rows})
    write_csv(table_path, rows)
    write_stages(os.path.join(sys.argv[2], "stages.svg"), rows)
    has_growth = write_growth(os.path.join(sys.argv[2], "growth.svg"), rows)
    has_pipeline = write_pipeline(os.path.join(sys.argv[2], "pipeline.svg"), rows)
    write_markdown(os.path.join(sys.argv[2], "RESULTS.md"), rows, [row for row in all_rows if "test" in row],
                   [row for row in all_rows if "error_of" in row], has_growth, has_pipeline)
    above = ["%s, %s, %s, %d threads: %.0f %% of the %s" % (r["case"], r["variant"], r["isa"], r["threads"], 100.0 * r[key], what)
             for r in rows for key, what, fewer in (("peak_share", "peak", 9 / 4 if WINOGRAD.match(r["case"]) else 1),
                                                    ("bandwidth_share", "bandwidth", 1)) if r.get(key, 0.0) > 1.02 * fewer]
    if above:
        sys.exit("results: shares above 100 %, so that a peak is measured too low:\n  " + "\n  ".join(above))


if __name__ == "__main__":
    main()
