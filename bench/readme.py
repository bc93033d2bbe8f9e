#!/usr/bin/env python3
"""Updates the tables of measured figures in README.md. The blocks between its markers are generated from bench/results.csv
(written by bench/run.sh) and bench/scenes.csv (written by bench/scenes.py).

    bench/readme.py [--check]

--check changes nothing and fails if README.md differs from the CSV files; the tests run it. A block whose CSV file is
missing is left alone. Needs only the standard library.
"""
import csv
import os
import re
import statistics
import sys

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
BF16 = "bf16 products"
KERNELS = [  # case, variant, name in README
    ("train step", "default", "a training step: render, loss, gradients, Adam"),
    ("linear f32 M=2048 N=3072 K=3072", "default", "a linear layer, 2048 x 3072 x 3072"),
    ("linear bf16 M=2048 N=3072 K=3072", BF16, "the same in bfloat16"),
    ("linear int8 M=2048 N=3072 K=3072", "default", "the same in 8-bit integers"),
    ("attention f32 H=48 D=64 Q=4096 K=4096", "default", "self-attention, 4096 tokens, 48 heads"),
    ("block f32 S=4096 R=0", "default", "a transformer block, 4096 tokens"),
    ("block bf16 S=4096 R=0", BF16, "the same in bfloat16"),
    ("conv3d f32 C=128 T=4 H=240 W=360", "default", "a causal convolution, 128 channels, 4 x 240 x 360"),
    ("t5 layer f32 S=226", "default", "one layer of T5-XXL, 226 tokens"),
    ("dinov2 f32 350x518 L=24", "default", "DINOv2-L, one photo of 350 x 518"),
    ("vggt pair f32 350x518 N=2", "default", "one frame and one global block of VGGT, two photos"),
]

ARMS = {"plain": "plain 3DGS", "none": "with regularisers", "warp": "and `warp`", "mini": "and `mini`"}
SCENES = {"fox": "stuffed fox on a wall", "Herz-Jesus-P25": "church facade", "kermit": "puppet", "bear": "plush bear",
          "archmodel": "wooden building model", "kitchen": "toy bulldozer", "monstree": "tree with a carved face",
          "plush": "doll on a bed"}


def read(name):
    try:
        with open(os.path.join(ROOT, "bench", name), newline="") as file:
            return list(csv.DictReader(file))
    except OSError:
        return None


def seconds(row):
    value = float(row["seconds"])
    return "%.3g s" % value if value >= 1.0 else "%.3g ms" % (1e3 * value)


def speed(rows):
    """One row per case with two threads: ours, with its fastest instruction set, and the fastest peer."""
    lines = ["| two cores | gsfixer | fastest peer | peer / gsfixer |", "|---|---|---|---|"]
    for case, variant, name in KERNELS:
        here = [r for r in rows if r["case"] == case and r["threads"] == "2"]
        ours = [r for r in here if r["variant"] == variant]
        if not ours:
            continue
        low = variant == BF16
        peers = [r for r in here if r["variant"] not in ("default", BF16) and r["variant"].endswith(" bf16") == low
                 and "alone" not in r["variant"]]
        best = min(peers, key=lambda r: float(r["seconds"])) if peers else None
        fastest = min(ours, key=lambda r: float(r["seconds"]))
        ratio = float(best["ratio"] or float(best["seconds"]) / float(fastest["seconds"])) if best else 0.0
        lines.append("| %s | %s | %s | %s |" % (
            name, seconds(fastest), "%s, %s" % (best["variant"].replace(" bf16", ""), seconds(best)) if best else "",
            ("%.0f" if ratio >= 10.0 else "%.2f") % ratio if best else ""))
    return lines


def figures(found):
    """Means over seeds, then over scenes: PSNR / SSIM."""
    of_scene = [[statistics.mean(float(r[k]) for r in found if r["scene"] == scene) for k in ("psnr", "ssim")]
                for scene in dict.fromkeys(r["scene"] for r in found)]
    return "%.2f / %.3f" % tuple(statistics.mean(column) for column in zip(*of_scene)) if of_scene else ""


def quality(rows):
    """Means over the scenes for each number of photos, then each scene with three photos."""
    head = "| %s | " + " | ".join(ARMS.values()) + " |"
    lines = [head % "photos", "|---|" + "---|" * len(ARMS)]
    for views in dict.fromkeys(r["views"] for r in rows):
        cells = [figures([r for r in rows if (r["views"], r["arm"]) == (views, arm)]) for arm in ARMS]
        lines.append("| %s | %s |" % (views, " | ".join(cells)))
    lines += ["", head % "scene, 3 photos", "|---|" + "---|" * len(ARMS)]
    for scene in dict.fromkeys(r["scene"] for r in rows):
        cells = [figures([r for r in rows if (r["scene"], r["views"], r["arm"]) == (scene, "3", arm)]) for arm in ARMS]
        lines.append("| %s | %s |" % (SCENES.get(scene, scene), " | ".join(cells)))
    return lines


def main():
    if sys.argv[1:] not in ([], ["--check"]):
        sys.exit(__doc__)
    path = os.path.join(ROOT, "README.md")
    with open(path) as file:
        text = file.read()
    fresh = text
    for name, source, make in (("speed", "results.csv", speed), ("quality", "scenes.csv", quality)):
        rows = read(source)
        if rows is None:
            continue
        block = "<!-- %s: bench/readme.py -->\n%s\n<!-- end -->" % (name, "\n".join(make(rows)))
        fresh, found = re.subn(r"<!-- %s: bench/readme.py -->\n.*?<!-- end -->" % name, lambda _: block, fresh, flags=re.S)
        if found != 1:
            sys.exit("readme: README.md has %d blocks \"%s\", not one" % (found, name))
    if sys.argv[1:] and fresh != text:
        sys.exit("readme: README.md differs from bench/*.csv; run bench/readme.py")
    if fresh != text:
        with open(path, "w") as file:
            file.write(fresh)


if __name__ == "__main__":
    main()
