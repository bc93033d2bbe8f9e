#!/usr/bin/env bash
# tests/dataset_scenes.sh SCRATCH [BUILD] [SCENES]: gsfix dataset with its default settings on SCENES (6) of make_scene's benchmark, 40
# photos of 320 x 240 each: undisturbed on one thread, killed twice and resumed, and by mpirun with 2 and 3 ranks of which one is
# killed. All must write the same bytes. Prints the seconds of each run, those per scene, and what 400 scenes take. Not part of
# run.sh: about ten minutes on two cores. BUILD: build.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ $# -ge 1 ] || { sed -n '2,5s/^# //p' "$0" >&2; exit 2; }
scratch=$1 build=${2:-build} scenes=${3:-6}
mkdir -p "$scratch/in"
scratch=$(cd "$scratch" && pwd) build=$(cd "$build" && pwd)
export OMP_WAIT_POLICY=passive OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
fail() { echo "$0: $*" >&2; tail -n 8 "$scratch/errors" >&2; exit 1; }
now() { date +%s.%N; }
since() { awk -v a="$1" -v b="$(now)" 'BEGIN { printf "%.1f", b - a }'; }
line() { printf '%-44s %8s s  %s\n' "$@"; }
same() { diff -r -x .gsfix "$scratch/whole" "$scratch/$1" > "$scratch/log" || fail "$2: other bytes"; rm -rf "${scratch:?}/$1"; }

for name in $("$build/make_scene" --suite | head -n "$scenes"); do
    [ -d "$scratch/in/$name" ] || "$build/make_scene" "$scratch/in/$name" --scene "$name" > "$scratch/log" 2> "$scratch/errors" ||
        fail "make_scene $name"
done
options=(dataset "$scratch"/in/* --threads 1 --checkpoint-every 100)

rm -rf "$scratch/whole"
begin=$(now)
TIMEFORMAT='%U %S'
used=$( { time "$build/gsfix" "${options[@]}" --out "$scratch/whole" > "$scratch/log" 2> "$scratch/errors"; } 2>&1 ) || fail "gsfix"
whole=$(since "$begin")
cpu=$(awk '{ print $1 + $2 }' <<< "$used")
line "one process, one thread, $scenes scenes" "$whole" "$cpu CPU s"

rm -rf "$scratch/killed"
begin=$(now) resume=()
for at in 2 5; do # killed while this scene is in training
    scene=$(ls "$scratch/in" | sed -n "$(( (at * scenes + 5) / 6 ))p")
    "$build/gsfix" "${options[@]}" --out "$scratch/killed" "${resume[@]}" > "$scratch/log" 2> "$scratch/errors" &
    while kill -0 $! 2> /dev/null && [ ! -e "$scratch/killed/$scene/checkpoint" ]; do sleep 0.05; done
    kill -9 $! || fail "not killed in $scene"
    wait $! 2> /dev/null || true
    resume=(--resume)
done
"$build/gsfix" "${options[@]}" --out "$scratch/killed" --resume > "$scratch/log" 2> "$scratch/errors" || fail "resumed"
line "killed twice and resumed" "$(since "$begin")" "same bytes"
same killed "killed twice"

for ranks in 2 3; do
    rm -rf "$scratch/mpi"
    begin=$(now)
    timeout 3600 mpirun --enable-recovery --oversubscribe --bind-to none -np "$ranks" "$build/gsfix_mpi" "${options[@]}" \
        --out "$scratch/mpi" > "$scratch/log" 2> "$scratch/errors" &
    mpi=$!
    while kill -0 $mpi 2> /dev/null && ! ls "$scratch"/mpi/*/checkpoint > /dev/null 2>&1; do sleep 0.05; done
    task=$(pgrep -f -- "^$build/gsfix_mpi .*--out $scratch/mpi --task " | head -n 1) || fail "no task is at work"
    kill -9 "$(ps -o ppid= -p "$task" | tr -d ' ')" || fail "no rank was killed"
    wait $mpi || fail "mpirun ended with status $?"
    line "mpirun -np $ranks, one rank killed" "$(since "$begin")" "same bytes"
    same mpi "$ranks ranks"
done
awk -v cpu="$cpu" -v n="$scenes" 'BEGIN { each = cpu / n
    printf "%.1f CPU s a scene; 400 scenes: %.2f hours on one core, %.2f on two, %.1f minutes on 100\n", each, each * 400 / 3600,
        each * 200 / 3600, each * 4 / 60 }'
