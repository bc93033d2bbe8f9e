#!/usr/bin/env python3
"""Time per training step of OpenSplat 1.2.0 on the CPU, as a row of bench_splat --json.

    bench/peer_opensplat.py OPENSPLAT SCENE [START.ply] [--steps 200] [--threads 2]

OpenSplat prints a line per step, after the backward pass and before Adam, so the time between two lines is one complete
step. Density control is off (it would begin after the run), all SH bands are active from the first step, no
downscaling. By default it performs Adam's step only every 32nd or 64th time in the second half of a run; this is
disabled here, since ours updates every splat in every step (OpenSplat still updates the SH bands above the first only
every 16th step). START.ply must have been written by OpenSplat. Wall seconds are the median over the steps after the
first, CPU seconds their mean.
"""
import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time


def first_step(ply):
    """The step after which OpenSplat resumes, from the PLY's header."""
    with open(ply, "rb") as file:
        found = re.search(rb"at iteration (\d+)", file.read(1000))
    if not found:
        sys.exit("peer_opensplat: %s is no file of OpenSplat's" % ply)
    return int(found.group(1))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("opensplat")
    parser.add_argument("scene")
    parser.add_argument("start", nargs="?")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        last = options.steps + 1 + (first_step(options.start) if options.start else 0)
        command = [options.opensplat, options.scene, "-n", str(last), "--sh-degree-interval", "1", "--densify-from", "1000000",
                   "--densify-until", "1000000", "-o", os.path.join(folder, "out.ply")]
        if options.start:
            command += ["--resume", options.start]
        environment = dict(os.environ, OMP_NUM_THREADS=str(options.threads))
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment, bufsize=0)
        clock = ((~process.pid) << 3) | 2  # the CPU clock of another process, as computed by clock_getcpuclockid
        stamps, rest = [], b""
        while True:
            block = os.read(process.stdout.fileno(), 65536)
            if not block:
                break
            now = time.monotonic()
            try:
                cpu = time.clock_gettime(clock)
            except OSError:
                cpu = float("nan")
            *lines, rest = (rest + block).split(b"\n")
            stamps += [(now, cpu) for line in lines if re.match(rb"Step \d+: ", line)]
        _, status, usage = os.wait4(process.pid, 0)
    if status != 0 or len(stamps) < 10:
        sys.exit("peer_opensplat: no timings (exit status %d, %d steps)" % (status, len(stamps)))
    wall = [b[0] - a[0] for a, b in zip(stamps, stamps[1:])]
    print(json.dumps({
        "bench": "splat", "case": "train step", "variant": "OpenSplat", "isa": "host", "threads": options.threads,
        "seconds": statistics.median(wall), "cpu_seconds": (stamps[-1][1] - stamps[0][1]) / len(wall),
        "work": len(wall), "work_unit": "steps", "rate": 1.0 / statistics.median(wall), "reference": "none",
        "peer": subprocess.run([options.opensplat, "--version"], stdout=subprocess.PIPE, text=True).stdout.strip(),
        "peak_rss_bytes": usage.ru_maxrss * 1024,
    }))


if __name__ == "__main__":
    main()
