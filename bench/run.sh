#!/usr/bin/env bash
# bench/run.sh [--quick]: builds the benches, runs them and writes bench/results.csv, bench/*.svg, bench/RESULTS.md and, unless
# --quick is given, the speed table in README.md. By environment variable:
#   PARTS="splats networks restorations metrics"  what to measure; the rows of the other parts stay as they are
#   optional measurements:
#   SCENE=COLMAP_FOLDER         training steps on its photos
#   START=PLY                   these splats instead of the scene's points as the start
#   OPENSPLAT=/path/opensplat   the same steps with OpenSplat, alternating with ours, and the ratio (needs SCENE)
#   ROUNDS=5 STEPS=200          rounds and steps of that comparison
#   TORCH=python3               the peers that this Python provides, and the ratios: network kernels (peers_nn.py), metrics
#                               (peers_metrics.py)
#   MODEL=FOLDER                one forward pass of this model, about 90 minutes (make_model --size full --parts transformer,vae)
# Without MODEL it takes about 80 minutes with all peers and fifty minutes without peers; --quick takes about two minutes. The
# machine should be otherwise idle.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
build=${GSF_BUILD:-build}
quick=()
[ "${1:-}" = --quick ] && quick=(--quick)
export OMP_WAIT_POLICY=passive # spinning workers would take CPU time from each other

cmake -S . -B "$build" -DCMAKE_BUILD_TYPE=Release > "$build.cmake.log" 2>&1 || { cat "$build.cmake.log" >&2; exit 1; }
rm -f "$build.cmake.log"
cmake --build "$build" -j "$(nproc)" --target bench_programs > /dev/null
temporary=$(mktemp -d)
trap 'rm -rf "$temporary"' EXIT
rows=$temporary/rows
parts=" ${PARTS:-splats networks restorations metrics} "
wanted() { [[ $parts == *" $1 "* ]]; }
beside() { # PEERS.py BENCH [OPTIONS]: a bench, with its peers if there are any
    if [ -n "${TORCH:-}" ]; then "$TORCH" "$@"; else "${@:2}" --json; fi | tee -a "$rows"
}
if wanted splats; then
    "$build/bench_splat" --json ${quick[@]+"${quick[@]}"} | tee "$rows"
    "$build/bench_splat" --json --growth | tee -a "$rows"
    [ ${#quick[@]} -gt 0 ] || "$build/bench_splat" --json --filter "visibility 5M" | tee -a "$rows"
fi
"$build/tests/test_stress" --json 2> /dev/null >> "$rows"
if wanted splats && [ -n "${SCENE:-}" ]; then
    steps=${STEPS:-200}
    for ((round = 0; round < ${ROUNDS:-5}; round++)); do
        "$build/bench_splat" --json --scene "$SCENE" ${START:+--start "$START"} --threads 2 --steps "$steps" | tee -a "$rows"
        [ -z "${OPENSPLAT:-}" ] || python3 bench/peer_opensplat.py "$OPENSPLAT" "$SCENE" ${START:+"$START"} --steps "$steps" |
            tee -a "$rows"
    done
fi
if wanted networks; then
    beside bench/peers_nn.py "$build/bench_nn" ${quick[@]+"${quick[@]}"}
fi
if wanted metrics; then # 1.3 GB of weights
    beside bench/peers_metrics.py "$build/bench_metrics" --models "$temporary/metrics" ${quick[@]+"${quick[@]}"}
fi
rm -rf "$temporary/metrics"
for golden in golden_metrics golden_metricnets; do # their errors against double precision
    GSF_TEST_ERRORS=$rows "$build/tests/$golden" > /dev/null
done
if wanted restorations; then
    for dtype in f32 bf16; do
        "$build/make_model" "$temporary/$dtype" --size small --dtype "$dtype" \
            --parts transformer,vae,scheduler,features > /dev/null
    done
    "$build/bench_nn" --json --filter pipeline ${quick[@]+"${quick[@]}"} --pipeline "$temporary/f32" \
        --pipeline "$temporary/bf16" | tee -a "$rows"
    [ -z "${MODEL:-}" ] || "$build/bench_nn" --json --filter model --threads 2 --model "$MODEL" | tee -a "$rows"
fi
status=0
python3 bench/results.py "$rows" bench || status=$?
[ ${#quick[@]} -gt 0 ] || python3 bench/readme.py
exit "$status"
