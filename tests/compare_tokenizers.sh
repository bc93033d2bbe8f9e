#!/usr/bin/env bash
# tests/compare_tokenizers.sh [COUNT]: compares both tokenizers with the sentencepiece and transformers packages on
# COUNT (10,000) random texts: ids and decoded texts must be equal. Installs the packages from PyPI into
# build/tokenizers; not part of CTest.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
build=${GSF_BUILD:-build}
count=${1:-10000}
[ -x "$build/tests/test_nn_text" ] && [ -x "$build/tests/test_nn_caption" ] ||
    { echo "$0: build the tests first (tests/run.sh)" >&2; exit 1; }
python=$build/tokenizers/bin/python
[ -x "$python" ] || python3 -m venv "$build/tokenizers"
"$python" -m pip install -q sentencepiece==0.2.3 transformers==4.51.3 regex tokenizers
"$python" tests/compare_tokenizer.py "$build/tests/test_nn_text" --train --count "$count"
"$python" tests/compare_bpe.py "$build/tests/test_nn_caption" --count "$count"
