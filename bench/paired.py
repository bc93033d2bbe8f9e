#!/usr/bin/env python3
"""Two builds of a benchmark in turn, case by case: CPU time of the second over that of the first.

    bench/paired.py OLD/bench_nn NEW/bench_nn [--rounds 6] [--more 3] [--limit 1.02] [--cpu 1] -- --quick --threads 1

Of all rounds the fastest counts. Cases above the limit are repeated, with those whose names begin with the same two words, up to
--more times --rounds rounds, since memory-bound cases need many rounds; what stays above the limit is listed first. Rows named
"machine" measure the machine, by the same code in both builds, and show how far the ratios can be trusted.
"""
import argparse
import json
import statistics
import subprocess
import sys


def run(program, args, cpu, times):
    command = ["taskset", "-c", str(cpu), program, "--json"] + args
    for line in subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines():
        if not line.startswith("{"):
            continue
        row = json.loads(line)
        key = (row["case"], row.get("variant", ""), row["isa"], row["threads"])
        times.setdefault(key, {}).setdefault(program, []).append(row["cpu_seconds"])


def rounds(options, args, times):
    for i in range(options.rounds):
        for program in (options.old, options.new) if i % 2 == 0 else (options.new, options.old):
            run(program, args, options.cpu, times)


def ratio(options, row):  # 0: not in both, or too short for the clock
    return min(row[options.new]) / min(row[options.old]) if len(row) == 2 and min(row[options.old]) > 0.0 else 0.0


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old")
    parser.add_argument("new")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--more", type=int, default=3)
    parser.add_argument("--limit", type=float, default=1.02)
    parser.add_argument("--cpu", type=int, default=1)
    end = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    options, args = parser.parse_args(sys.argv[1:end]), sys.argv[end + 1:] # args: of both programs
    times = {}
    rounds(options, args, times)
    for _ in range(options.more):
        groups = {" ".join(key[0].split()[:2]) for key, row in times.items()
                  if ratio(options, row) > options.limit and "machine" not in key[0]}
        for group in sorted(groups): # the programs filter groups of cases, whose names begin alike
            rounds(options, args + ["--filter", group], times)
    both = sorted(((ratio(options, row), key) for key, row in times.items() if len(row) == 2), reverse=True)
    print("| case | instructions | threads | %s | %s | ratio | rounds |\n|---|---|---|---|---|---|---|" % ("old ms", "new ms"))
    for value, key in both:
        row = times[key]
        print("| %s %s | %s | %d | %.4f | %.4f | %.3f | %d |" % (
            key[0], "" if key[1] == "default" else key[1], key[2], key[3], 1e3 * min(row[options.old]),
            1e3 * min(row[options.new]), value, len(row[options.new])))
    own = [value for value, key in both if "machine" not in key[0]]
    print("\n%d cases, median %.3f, %d above %.2f" % (len(own), statistics.median(own), sum(v > options.limit for v in own),
                                                     options.limit))


if __name__ == "__main__":
    main()
