"""What the benches of whole runs, quality.py, headroom.py and scenes.py, share: arms, commands with their CPU time, result files
that are complete or absent, means. Needs only the standard library.
"""
import concurrent.futures
import json
import math
import os
import subprocess
import sys


def split_arm(text):
    """Name, program ("" unless given) and arguments of an arm, NAME=ARGS or NAME@PROGRAM=ARGS."""
    head, _, arguments = text.partition("=")
    name, _, program = head.partition("@")
    return name, program, arguments


def run(command, **environment):
    """Runs a command with additional environment variables; returns its standard output and CPU seconds. Exits if the
    command fails."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                               env=dict(os.environ, **environment))
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        errors = pool.submit(process.stderr.read)
        text = process.stdout.read()
        _, status, usage = os.wait4(process.pid, 0)
        errors = errors.result()
    process.returncode = os.waitstatus_to_exitcode(status)
    if status != 0:
        sys.exit("failed (%d): %s\n  %s" % (process.returncode, " ".join(command),
                                            (errors.strip().splitlines() or ["no message"])[-1]))
    return text, usage.ru_utime + usage.ru_stime


def read_json(path):
    try:
        with open(path) as file:
            return json.load(file)
    except OSError:
        return None


def write_json(path, value):
    with open(path + ".part", "w") as file:
        json.dump(value, file)
    os.rename(file.name, path)


def mean_and_error(values):
    """Mean and standard error; NaN where there are too few values."""
    n = len(values)
    if n == 0:
        return float("nan"), float("nan")
    mean = sum(values) / n
    if n < 2:
        return mean, float("nan")
    return mean, math.sqrt(sum((v - mean) ** 2 for v in values) / (n - 1) / n)
