#!/usr/bin/env bash
# tests/packages.sh VENV [GSFIX]: gsfix metrics beside the Python packages that people use, on random images and random
# weights: scikit-image, torchmetrics, pytorch-msssim, lpips, dreamsim's transformers, ftfy. VENV is a Python environment outside
# this tree; what it lacks is installed there with pip (about 3 GB with PyTorch). Not part of run.sh. GSFIX: build/gsfix.
# Prints a table and exits with 1 if a value is further off than its bar.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ $# -ge 1 ] || { sed -n '2,5s/^# //p' "$0" >&2; exit 2; }
venv=$1 gsfix=${2:-build/gsfix}
[ -x "$venv/bin/python" ] || python3 -m venv "$venv"
wanted=(torch torchvision numpy pillow safetensors scikit-image torchmetrics pytorch-msssim lpips ftfy regex)
"$venv/bin/python" -c "import torch, torchvision, numpy, PIL, safetensors, skimage, torchmetrics, pytorch_msssim, lpips, ftfy, regex" \
    2> /dev/null || "$venv/bin/pip" install --quiet "${wanted[@]}"
"$venv/bin/pip" show --quiet dreamsim 2> /dev/null || "$venv/bin/pip" install --quiet --no-deps dreamsim # only one of its files
exec "$venv/bin/python" tests/packages.py "$gsfix"
