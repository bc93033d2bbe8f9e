#!/usr/bin/env bash
# render_only.sh: render_only.c built by each compiler at -O2 and -O3 agrees with the double-precision reference, and all
# builds agree with each other bit for bit.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
export GSF_GOLDEN=${GSF_GOLDEN:-$PWD/tests/golden}
compilers=(gcc)
for clang in clang clang-14; do
    if command -v "$clang" > /dev/null; then compilers+=("$clang"); break; fi
done
failures=0 builds=0
for compiler in "${compilers[@]}"; do
    for level in -O2 -O3; do
        "$compiler" -std=c11 $level -DNDEBUG -w -I. -Itests tests/compile/render_only.c -o "$work/program" -lm
        builds=$((builds + 1))
        "$work/program" > "$work/images" || { echo "FAILED $compiler $level"; failures=$((failures + 1)); }
        [ -e "$work/first" ] || cp "$work/images" "$work/first"
        cmp "$work/first" "$work/images" || { echo "$compiler $level: other bits"; failures=$((failures + 1)); }
    done
done
cat "$work/first"
echo "$builds builds, $failures failed"
[ "$failures" = 0 ]
