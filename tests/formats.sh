#!/usr/bin/env bash
# tests/formats.sh VENV [GSFIX]: the formats of gsfix beside independent readers and writers, pygltflib, plyfile, gsply and
# pycolmap. VENV is a Python environment outside this tree; what it lacks is installed there with pip. Not part of run.sh.
# GSFIX: build/gsfix; make_scene has to be beside it. Prints a table and exits with 1 if a value is further off than its bar.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ $# -ge 1 ] || { sed -n '2,4s/^# //p' "$0" >&2; exit 2; }
venv=$1 gsfix=${2:-build/gsfix}
[ -x "$venv/bin/python" ] || python3 -m venv "$venv"
packages=(numpy plyfile pygltflib gsply zstandard pycolmap)
"$venv/bin/python" -c "import $(IFS=,; echo "${packages[*]}")" 2> /dev/null || "$venv/bin/pip" install --quiet "${packages[@]}"
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
"$(dirname "$gsfix")/make_scene" "$scratch/scene" --views 8 --width 96 --height 64 --points 800 > /dev/null
"$venv/bin/python" tests/formats.py "$gsfix" "$scratch/scene"
