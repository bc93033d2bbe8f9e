#!/usr/bin/env bash
# tests/formats.sh VENV [GSFIX]: the splat formats of gsfix beside independent readers and writers, pygltflib and plyfile.
# VENV is a Python environment outside this tree; what it lacks is installed there with pip. Not part of run.sh.
# GSFIX: build/gsfix. Prints a table and exits with 1 if a value is further off than its bar.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ $# -ge 1 ] || { sed -n '2,4s/^# //p' "$0" >&2; exit 2; }
venv=$1 gsfix=${2:-build/gsfix}
[ -x "$venv/bin/python" ] || python3 -m venv "$venv"
"$venv/bin/python" -c "import numpy, plyfile, pygltflib" 2> /dev/null || "$venv/bin/pip" install --quiet numpy plyfile pygltflib
exec "$venv/bin/python" tests/formats.py "$gsfix"
