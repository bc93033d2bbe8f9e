#!/usr/bin/env python3
"""Runs bench_nn and then PyTorch on the same cases, and prints the ratio of the two.

    bench/peers_nn.py BENCH_NN [--quick] [--filter TEXT] [--threads N] [--rounds N]

BENCH_NN is the built program; its rows are passed through. Every case that PyTorch can do, too, is read from its name and
timed on as many threads right after; that row has variant "PyTorch" and "ratio": PyTorch's seconds divided by ours (above 1:
we are faster), "cpu_ratio" the same of CPU seconds, for machines that do other things as well. --rounds repeats the two in
turns; the median counts. Needs PyTorch (pip install torch); without it only our rows are printed and the exit code is 77.
"""
import argparse
import json
import re
import statistics
import subprocess
import sys
import time

try:
    import torch
except ImportError:
    torch = None

CYCLE_BYTES = 1 << 30  # up to 4 rows: over this much of distinct weights, as bench_nn does (a quarter with --quick)


def measure(function, units, quick):
    """Median seconds and least CPU seconds of one unit; function does `units` of them."""
    wall, cpu = [], []
    function()
    start = time.perf_counter()
    while len(wall) < 3 or (time.perf_counter() - start < (0.3 if quick else 1.5) and len(wall) < 100):
        t, c = time.perf_counter(), time.process_time()
        function()
        wall.append((time.perf_counter() - t) / units)
        cpu.append((time.process_time() - c) / units)
    return statistics.median(wall), min(cpu)


def linear(match, quick):
    dtype = {"f32": torch.float32, "bf16": torch.bfloat16, "f16": torch.float16}[match.group(1)]
    m, n, k = (int(match.group(i)) for i in (2, 3, 4))
    size = n * k * torch.tensor([], dtype=dtype).element_size()
    copies = max(1, (CYCLE_BYTES >> (2 if quick else 0)) // size) if m <= 4 else 1
    weights = [torch.rand(n, k).sub_(0.5).to(dtype) for _ in range(copies)]
    x, bias = torch.rand(m, k).sub_(0.5).to(dtype), torch.rand(n).to(dtype)
    after = {"": None, "gelu": lambda y: torch.nn.functional.gelu(y, approximate="tanh"),
             "silu": torch.nn.functional.silu}[match.group(5) or ""]

    def run():
        for w in weights:
            y = torch.nn.functional.linear(x, w, bias)
            if after:
                after(y)
    return run, copies


CASES = [ # name of a case, what makes (function, units)
    (re.compile(r"linear (f32|bf16|f16) M=(\d+) N=(\d+) K=(\d+)(?: (gelu|silu))?$"), linear),
]


def peer_row(ours, quick):
    for pattern, make in CASES:
        match = pattern.match(ours["case"])
        if not match:
            continue
        torch.set_num_threads(ours["threads"])
        with torch.inference_mode():
            run, units = make(match, quick)
            seconds, cpu = measure(run, units, quick)
        row = {key: ours[key] for key in ("bench", "case", "isa", "threads", "work", "work_unit")}
        row.update(variant="PyTorch", seconds=seconds, cpu_seconds=cpu, rate=ours["work"] / seconds, reference="none",
                   peer=torch.__version__)
        if "peak_share" in ours:  # by the same peak
            row["peak_share"] = ours["peak_share"] * ours["seconds"] / seconds
        return row
    return None


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bench")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--filter")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--rounds", type=int, default=1)
    options = parser.parse_args()
    command = [options.bench, "--json"] + ["--quick"] * options.quick
    command += ["--filter", options.filter] if options.filter else []
    command += ["--threads", str(options.threads)] if options.threads else []
    pairs = {}
    for _ in range(options.rounds):
        for line in subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines():
            ours = json.loads(line)
            print(line, flush=True)
            if torch is None or ours["variant"] != "default" or ours["isa"] == "scalar":
                continue
            theirs = peer_row(ours, options.quick)
            if theirs:
                pairs.setdefault((ours["case"], ours["threads"]), []).append((ours, theirs))
    for rows in pairs.values():
        row = dict(rows[-1][1])
        row["ratio"] = round(statistics.median(t["seconds"] / o["seconds"] for o, t in rows), 3)
        row["cpu_ratio"] = round(statistics.median(t["cpu_seconds"] / o["cpu_seconds"] for o, t in rows), 3)
        print(json.dumps(row))
    if torch is None:
        print("peers_nn.py: PyTorch is not installed", file=sys.stderr)
        return 77
    return 0


if __name__ == "__main__":
    sys.exit(main())
