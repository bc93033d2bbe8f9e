#!/usr/bin/env bash
# tests/coverage.sh [-v]: line coverage of the parsers of JSON and safetensors by their tests and the replayed fuzz
# corpora (-v: also lists the lines not covered). Run by hand; needs clang-14 and llvm-14. COVERAGE=folder keeps the
# compiled programs.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
out=${COVERAGE:-$(mktemp -d)}
mkdir -p "$out/tmp"
[ -n "${COVERAGE:-}" ] || trap 'rm -rf "$out"' EXIT
flags=(-std=c11 -O1 -w -fprofile-instr-generate -fcoverage-mapping -DGSFIXER_STATIC -DGSFIXER_IMPLEMENTATION -I. -Itests
    "-DTEST_GOLDEN=\"$PWD/tests/golden\"" "-DTEST_TMP=\"$out/tmp\"")
rm -f "$out"/*.profraw
for name in test_gsfixer test_nn_files test_model fuzz_json fuzz_safetensors; do
    more=() corpus=()
    [[ $name != fuzz_* ]] || { more=(tests/fuzz_driver.c) corpus=("tests/corpus/${name#fuzz_}"); }
    clang-14 "${flags[@]}" "tests/$name.c" "${more[@]}" -lm -o "$out/$name"
    LLVM_PROFILE_FILE="$out/$name.profraw" "$out/$name" "${corpus[@]}" > "$out/$name.log" 2>&1 ||
        { tail -n 20 "$out/$name.log" >&2; exit 1; }
    objects+=(-object "$out/$name")
done
llvm-profdata-14 merge -o "$out/all.profdata" "$out"/*.profraw

# Lines of FILE from the marker FIRST up to the marker END.
section() { # LABEL FILE FIRST END
    local first end
    first=$(grep -nF -- "// ---- $3" "$2" | tail -n 1 | cut -d: -f1)
    end=$(grep -nF -- "// ---- $4" "$2" | tail -n 1 | cut -d: -f1)
    llvm-cov-14 export -format=lcov -instr-profile="$out/all.profdata" "${objects[@]:1}" "$PWD/$2" 2> "$out/cov.log" |
        awk -F'[:,]' -v first="$first" -v end="$end" -v label="$1" -v verbose="$verbose" -v file="$2" '
            $1 == "DA" && $2 >= first && $2 < end { all[$2] = 1; if ($3 > 0) hit[$2] = 1 }
            END {
                for (l in all) { n++; if (l in hit) c++ }
                printf "%-40s %5d of %5d lines, %.2f %%\n", label, c, n, 100 * c / n
                if (verbose) while ((getline text < file) > 0) { at++; if (at in all && !(at in hit)) print at ": " text }
            }'
}
verbose=0
[ "${1:-}" != -v ] || verbose=1
section "JSON (gsfixer.h)" gsfixer.h ">>json" ">>images"
section "safetensors: opening, folders, writing" gsfixer_nn.h ">>nn files" "for the networks: taking tensors"
section "tensors by name, config.json" gsfixer_nn.h "for the networks: taking tensors" ">>nn vector"
