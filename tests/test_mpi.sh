#!/usr/bin/env bash
# test_mpi.sh GSFIX GSFIX_MPI SCENE SCRATCH: gsfix_mpi with 1, 2 and 3 ranks writes the bytes of gsfix; so it does where a task's
# process or a rank is killed, and where rank 0 is killed and the command repeated with --resume.
set -euo pipefail
gsfix=$1 gsfix_mpi=$2 scene=$3 scratch=$4
[ -x "$gsfix" ] && [ -x "$gsfix_mpi" ] && [ -d "$scene" ] || { echo "SKIPPED: no program or no scene"; exit 77; }
command -v mpirun > /dev/null || { echo "SKIPPED: no mpirun"; exit 77; }
rm -rf "$scratch"
mkdir -p "$scratch/in"
export OMP_WAIT_POLICY=passive OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
cp -r "$scene" "$scratch/in/a"
cp -r "$scene" "$scratch/in/b"
evaluate=(evaluate "$scratch/in/a" "$scratch/in/b" --views 3 --frames 4 --iterations 40 --max-size 48 --checkpoint-every 10 --threads 1)
dataset=(dataset "$scratch/in/a" "$scratch/in/b" --views 3 --frames 4 --iterations 40 --max-size 48 --checkpoint-every 10 --threads 1)
recovery=
ranks() { # N COMMAND...: in the background
    local n=$1
    shift
    timeout 120 mpirun $recovery --oversubscribe --bind-to none -np "$n" "$gsfix_mpi" "$@" > "$scratch/log" 2> "$scratch/errors" &
    mpi=$!
}
fail() { echo "$0: $*"; tail -n 8 "$scratch/log" "$scratch/errors"; kill -9 "$mpi" 2> /dev/null || true; exit 1; }
same() { diff -r -x .gsfix "$scratch/$1" "$scratch/mpi" > "$scratch/log" || fail "$2"; }
ended() { wait "$mpi" || fail "mpirun ended with status $?"; }
find_process() { # PATTERN WHICH: sets pid to that of the process whose command line matches, once it is there
    local try
    for try in $(seq 400); do
        pid=$(pgrep -f -- "$1" | sed -n "$2p") || true
        [ -z "$pid" ] || return 0
        sleep 0.01
    done
    fail "no process $1"
}

"$gsfix" "${evaluate[@]}" --out "$scratch/one" > "$scratch/log" 2> "$scratch/errors" || { mpi=0; fail "gsfix alone"; }
"$gsfix" "${dataset[@]}" --out "$scratch/set" > "$scratch/log" 2> "$scratch/errors" || { mpi=0; fail "gsfix alone"; }

for n in 1 2 3; do
    rm -rf "$scratch/mpi"
    ranks "$n" "${evaluate[@]}" --out "$scratch/mpi"
    ended
    same one "$n ranks"
done
rm -rf "$scratch/mpi"
ranks 3 "${dataset[@]}" --out "$scratch/mpi"
find_process "^$gsfix_mpi .*--out $scratch/mpi --task " 1
kill -9 "$pid" 2> /dev/null || true
ended
same set "a task's process was killed"

recovery=--enable-recovery # with which mpirun ends with 0, whatever a rank's exit status is
for n in 2 3; do # a rank is killed while it is at work
    rm -rf "$scratch/mpi"
    ranks "$n" "${evaluate[@]}" --out "$scratch/mpi"
    find_process "^$gsfix_mpi .*--out $scratch/mpi --task " 1
    kill -9 "$(ps -o ppid= -p "$pid" | tr -d ' ')" 2> /dev/null || true
    ended
    same one "$n ranks, one of them killed"
done
rm -rf "$scratch/mpi"
ranks 2 "${evaluate[@]}" --out "$scratch/mpi"
find_process "^$gsfix_mpi .*--out $scratch/mpi --task " 1
kill -9 "$(pgrep -P "$(pgrep -P "$mpi")" | sort -n | head -n 1)" # the rank that was started first
wait "$mpi" || true
[ ! -e "$scratch/mpi/tables.md" ] || fail "rank 0 was not killed"
ranks 1 "${evaluate[@]}" --out "$scratch/mpi" --resume
ended
same one "repeated with --resume, one rank"
recovery=

ranks 2 evaluate --frobnicate
status=0
wait "$mpi" || status=$?
[ "$status" = 2 ] && grep -q "no option --frobnicate" "$scratch/errors" || fail "bad usage ended with status $status"
mv "$scratch/in/b/images" "$scratch/in/b/away"
ranks 3 "${evaluate[@]}" --out "$scratch/part"
status=0
wait "$mpi" || status=$?
[ "$status" = 1 ] && grep -q "^gsfix evaluate: 6 of 12 not done" "$scratch/errors" || fail "a failed scene ended with status $status"
grep -q "b.restored.warp.s0: needs b.artifacts.k3.s0, which is not done" "$scratch/errors" || fail "tasks that need a failed one"
echo "same bytes with 1, 2 and 3 ranks and with killed tasks and ranks"
