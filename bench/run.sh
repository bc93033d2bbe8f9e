#!/usr/bin/env bash
# bench/run.sh [--quick]: builds the benches, runs them and writes bench/results.csv, bench/*.svg, bench/RESULTS.md and (not
# --quick) README's figures of speed.
#   SCENE=COLMAP_FOLDER       training steps on its photos as well
#   START=PLY                 from these splats instead of the scene's points
#   OPENSPLAT=/path/opensplat and the same steps by OpenSplat in turns with ours, with the ratio (needs SCENE)
#   ROUNDS=5 STEPS=200        of that comparison
#   TORCH=python3             and the networks' kernels by the peers that this Python has, with the ratios (peers_nn.py)
#   MODEL=FOLDER              and one pass of it: about an hour and a half (make_model --size full --parts transformer,vae)
# About an hour with all peers, forty minutes without (and without MODEL); --quick is a look at it in two. The machine should do nothing else.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
build=${GSF_BUILD:-build}
quick=()
[ "${1:-}" = --quick ] && quick=(--quick)
export OMP_WAIT_POLICY=passive # two workers that spin while they wait take each other's time

cmake -S . -B "$build" -DCMAKE_BUILD_TYPE=Release > "$build.cmake.log" 2>&1 || { cat "$build.cmake.log" >&2; exit 1; }
rm -f "$build.cmake.log"
cmake --build "$build" -j "$(nproc)" --target bench_splat bench_nn make_model test_stress > /dev/null
temporary=$(mktemp -d)
trap 'rm -rf "$temporary"' EXIT
rows=$temporary/rows
"$build/bench_splat" --json ${quick[@]+"${quick[@]}"} | tee "$rows"
"$build/bench_splat" --json --growth | tee -a "$rows"
[ ${#quick[@]} -gt 0 ] || "$build/bench_splat" --json --filter "visibility 5M" | tee -a "$rows"
"$build/tests/test_stress" --json 2> /dev/null >> "$rows"
if [ -n "${SCENE:-}" ]; then
    steps=${STEPS:-200}
    for ((round = 0; round < ${ROUNDS:-5}; round++)); do
        "$build/bench_splat" --json --scene "$SCENE" ${START:+--start "$START"} --threads 2 --steps "$steps" | tee -a "$rows"
        [ -z "${OPENSPLAT:-}" ] || python3 bench/peer_opensplat.py "$OPENSPLAT" "$SCENE" ${START:+"$START"} --steps "$steps" |
            tee -a "$rows"
    done
fi
if [ -n "${TORCH:-}" ]; then
    "$TORCH" bench/peers_nn.py "$build/bench_nn" ${quick[@]+"${quick[@]}"} | tee -a "$rows"
else
    "$build/bench_nn" --json ${quick[@]+"${quick[@]}"} | tee -a "$rows"
fi
for dtype in f32 bf16; do
    "$build/make_model" "$temporary/$dtype" --size small --dtype "$dtype" \
        --parts transformer,vae,scheduler,features > /dev/null
done
"$build/bench_nn" --json --filter pipeline ${quick[@]+"${quick[@]}"} --pipeline "$temporary/f32" --pipeline "$temporary/bf16" |
    tee -a "$rows"
[ -z "${MODEL:-}" ] || "$build/bench_nn" --json --filter model --threads 2 --model "$MODEL" | tee -a "$rows"
status=0
python3 bench/results.py "$rows" bench || status=$?
[ ${#quick[@]} -gt 0 ] || python3 bench/readme.py
exit "$status"
