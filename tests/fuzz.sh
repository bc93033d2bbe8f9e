#!/usr/bin/env bash
# tests/fuzz.sh [SECONDS] [TARGET...]: libFuzzer with AddressSanitizer and UndefinedBehaviorSanitizer, SECONDS (600) for each
# TARGET (all; "ply" is fuzz_ply.c). Needs clang-14 and libclang-rt-14-dev. Not part of run.sh, which replays the corpora.
#   build/fuzz/             the build tree
#   build/fuzz/run/TARGET/  log, findings, and corpus/, a copy of tests/corpus/TARGET plus new inputs
# Prints a table at the end; exits with 1 if there was a finding: a crash, undefined behaviour, a leak, an input that takes
# 5 s, or memory above 1 GiB (256 MiB in one allocation).
# GSF_FUZZ_JOBS=N runs N targets in parallel (default 1).
# To add new inputs to the corpus:  build/fuzz/tests/fuzz_ply -merge=1 tests/corpus/ply build/fuzz/run/ply/corpus
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
build=$PWD/build/fuzz
seconds=600
if [[ ${1:-} =~ ^[0-9]+$ ]]; then
    seconds=$1
    shift
fi
targets=("$@")
if [ ${#targets[@]} = 0 ]; then
    for source in tests/fuzz_*.c; do
        name=${source#tests/fuzz_}
        [ "$name" = driver.c ] || targets+=("${name%.c}")
    done
fi

mkdir -p "$build"
flags="-O1 -g -finline-hint-functions"
{
    CC=clang-14 CXX=clang++-14 cmake -S . -B "$build" -DCMAKE_BUILD_TYPE=Sanitize "-DCMAKE_C_FLAGS=$flags" \
        "-DCMAKE_CXX_FLAGS=$flags" -DGSFIXER_LIBFUZZER=ON -DGSFIXER_SANITIZE=address,undefined -DGSFIXER_WERROR=ON \
        -DGSFIXER_BENCH=OFF -DGSFIXER_EXAMPLES=OFF -DGSFIXER_OPENMP=OFF -DGSFIXER_EMBREE=OFF -DGSFIXER_OIIO=OFF
    cmake --build "$build" --target "${targets[@]/#/fuzz_}"
} > "$build/build.log" 2>&1 || { tail -n 30 "$build/build.log" >&2; exit 1; }

# A small quarantine: freed blocks are reused soon, so that fewer pages are touched for the first time.
export ASAN_OPTIONS=${ASAN_OPTIONS:-quarantine_size_mb=8}
export UBSAN_OPTIONS=${UBSAN_OPTIONS:-print_stacktrace=1}

fuzz() { # TARGET SECONDS BUILD: one line of the table in run/TARGET/row
    local folder=$3/run/$1 status=0 TIMEFORMAT='cpu: %U %S'
    rm -rf "$folder"
    cp -r "tests/corpus/$1/." "$(mkdir -p "$folder/corpus" && echo "$folder/corpus")"
    cp "$3/tests/fuzz_$1" "$folder/target" # so that a later build does not replace it
    { time "$folder/target" -max_total_time="$2" -max_len=8192 -timeout=5 -rss_limit_mb=1024 -malloc_limit_mb=256 \
        -print_final_stats=1 -artifact_prefix="$folder/" "$folder/corpus" > "$folder/log" 2>&1; } 2> "$folder/time" || status=$?
    awk -v target="$1" -v status="$status" -v log_file="$folder/log" '
        FILENAME != log_file { cpu = $2 + $3 }
        /^stat::number_of_executed_units/ { runs = $2 }
        /^stat::average_exec_per_sec/ { rate = $2 }
        /^stat::peak_rss_mb/ { peak = $2 }
        / cov: / { for (i = 1; i < NF; i++) if ($i == "cov:") cov = $(i + 1) }
        END { printf "%-12s %12d %8d %12d %9d %8d  %s\n", target, runs, rate, (cpu ? runs / cpu : 0), cov, peak,
                  (status ? "exit code " status ", see " log_file : "none") }' "$folder/log" "$folder/time" > "$folder/row"
    return "$status"
}
export -f fuzz

status=0
printf '%s\n' "${targets[@]}" | xargs -P "${GSF_FUZZ_JOBS:-1}" -I{} bash -c 'fuzz "$@"' - {} "$seconds" "$build" || status=1
printf '%-12s %12s %8s %12s %9s %8s  %s\n' target executions per-sec per-cpu-sec coverage peak-MB findings
for target in "${targets[@]}"; do cat "$build/run/$target/row"; done
exit "$status"
