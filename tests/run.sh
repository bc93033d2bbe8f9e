#!/usr/bin/env bash
# tests/run.sh [CTEST ARGUMENTS]: runs all tests, also on a fresh Debian machine.
#   build/        gcc, Release: all tests, and again with the scalar kernels; compile matrix; style; consumers; fuzz corpora
#   build/asan/   clang, AddressSanitizer and UndefinedBehaviorSanitizer: all tests and fuzz corpora
#   build/tsan/   clang, ThreadSanitizer: the threaded tests, on a pthread job system
#   build/windows/  MinGW, under Wine: the core of the tests and gsfix
#   build/arm/      64-bit Arm, under QEMU: the kernels' tests; with GSF_ARM_ALL=1 all tests, which takes hours
#   build/web/      WebAssembly, in node: the kernels' tests
#   build/all/    one ctest run over all; its log is build/all/Testing/Temporary/LastTest.log
# Missing packages are installed with apt-get (as root or with sudo); if none is missing, the network is not used.
# Tests that need the fox photos (../shared/data/fox beside the checkout, or GSF_FOX=folder) are skipped without them.
# GSF_BUILD=folder replaces build/.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
root=$PWD
build=${GSF_BUILD:-$root/build}
jobs=$(nproc 2> /dev/null || echo 2)
started=$SECONDS

packages=(cmake make gcc g++ libc6-dev pkg-config clang-14 libclang-rt-14-dev libomp-14-dev libembree-dev libstb-dev libzstd-dev
    libglm-dev libopenimageio-dev libopenmpi-dev openmpi-bin libsdl2-dev xvfb xauth python3
    gcc-mingw-w64-x86-64-posix wine wine64 gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user emscripten tcc)
say() { printf '== %s\n' "$*"; }

install_missing() {
    command -v dpkg-query > /dev/null || { say "no dpkg here: what is missing has to be installed by hand"; return; }
    local missing=() package state
    for package in "${packages[@]}"; do
        state=$(dpkg-query -W -f '${db:Status-Status}' "$package" 2> /dev/null || true)
        [ "$state" = installed ] || missing+=("$package")
    done
    [ ${#missing[@]} -gt 0 ] || return 0
    say "installing ${missing[*]}"
    local as_root=() apt=(apt-get -q -o DPkg::Lock::Timeout=300)
    if [ "$(id -u)" != 0 ]; then
        command -v sudo > /dev/null || { echo "$0: not root and no sudo; install by hand: ${missing[*]}" >&2; exit 1; }
        as_root=(sudo)
    fi
    "${as_root[@]}" "${apt[@]}" update
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive "${apt[@]}" install -y --no-install-recommends "${missing[@]}"
}

mkdir -p "$build/all"
# Output goes to a log that is shown only if the step fails.
step() { # LOG COMMAND...
    local log=$build/$1.log
    shift
    "$@" > "$log" 2>&1 || { tail -n 60 "$log" >&2; echo "$0: failed: $* (whole log: $log)" >&2; exit 1; }
}

# clang 14's ThreadSanitizer crashes at start on kernels that randomise more address bits than it expects.
tsan_launcher() {
    local probe=$build/tsan_probe
    printf 'int main(void) { return 0; }\n' > "$probe.c"
    clang-14 -fsanitize=thread "$probe.c" -o "$probe"
    local try
    for try in 1 2 3 4 5; do
        "$probe" 2> /dev/null || { echo "setarch;$(uname -m);-R"; return; }
    done
}

names=() trees=()
configure_tree() { # NAME FOLDER CMAKE-ARGUMENT...
    local name=$1 folder=$2
    shift 2
    say "configuring $name"
    step "$name.configure" cmake -G "Unix Makefiles" -S "$root" -B "$folder" -DGSFIXER_WERROR=ON "$@"
    names+=("$name") trees+=("$folder")
}

# All trees at once, so that no core waits for the last program of a tree.
build_trees() {
    local i
    {
        echo "all: ${names[*]}"
        for i in "${!names[@]}"; do
            printf '%s:\n\t+@$(MAKE) -C "%s" > "%s.log" 2>&1 || { tail -n 60 "%s.log" >&2; false; }\n' \
                "${names[i]}" "${trees[i]}" "$build/${names[i]}.build" "$build/${names[i]}.build"
        done
    } > "$build/all/Makefile"
    say "building ${names[*]}"
    make --no-print-directory -C "$build/all" -j"$jobs" || { echo "$0: the build failed (logs: $build/*.build.log)" >&2; exit 1; }
}

install_missing

# The compiler is passed by environment: as an option, one that differs from the tree's makes CMake forget all other
# options. If build/ was configured with another compiler, it is recreated.
if ! grep -qE '^CMAKE_C_COMPILER:[A-Z]+=.*/(gcc|cc)$' "$build/CMakeCache.txt" 2> /dev/null; then
    rm -rf "$build/CMakeCache.txt" "$build/CMakeFiles"
fi
export CC=gcc CXX=g++
configure_tree gcc "$build" -DCMAKE_BUILD_TYPE=Release -DGSFIXER_TEST_SCALAR=ON
export CC=clang-14 CXX=clang++-14
# Inlining only functions marked inline saves a quarter of the compile time without slowing the tests down.
flags="-O1 -gline-tables-only -finline-hint-functions"
# What this machine cannot run is left out of the trees that only run here: a third of what takes longest to compile.
narrow=$(grep -q avx512vl /proc/cpuinfo || echo " -DGSF_NO_AVX512")
flags+=$narrow
clang=(-DCMAKE_BUILD_TYPE=Sanitize "-DCMAKE_C_FLAGS=$flags" "-DCMAKE_CXX_FLAGS=$flags" -DGSFIXER_BENCH=OFF)
# In C, undefined behaviour traps, which AddressSanitizer reports with file and line (handle_sigill): a fifth less to compile
# than messages. C++ has checks that cannot trap.
configure_tree asan "$build/asan" "${clang[@]}" "-DCMAKE_C_FLAGS=$flags -fsanitize-trap=undefined" \
    -DGSFIXER_SANITIZE=address,undefined -DGSFIXER_TEST_PREFIX=asan.
configure_tree tsan "$build/tsan" "${clang[@]}" -DGSFIXER_SANITIZE=thread -DGSFIXER_TEST_PREFIX=tsan. -DGSFIXER_OPENMP=OFF \
    "-DCMAKE_CROSSCOMPILING_EMULATOR=$(tsan_launcher)"
unset CC CXX

# Other platforms, each as far as its tools are there. Wine keeps its settings in the build tree.
export WINEPREFIX=$build/wine
export NODE_PATH=/usr/share/nodejs:/usr/lib/nodejs # of Debian's node, whatever node is first in PATH
kernels="test_lanes;test_maths;test_platforms;golden_splat;golden_metrics"
core="$kernels;test_gsfixer;test_context;test_resize;test_formats;test_traj;test_schedule;test_clips;test_scene;\
test_few_views;test_nn_files;test_nn_kernels;test_nn_linear;test_nn_scheduler;test_nn_text;test_threads;test_names;\
test_replace;golden_traj;golden_training;golden_encoders"
cross_tree() { # NAME TOOL FLAGS TESTS
    command -v "$2" > /dev/null || { say "no $2 here: nothing is run on $1"; return; }
    configure_tree "$1" "$build/$1" "-DCMAKE_TOOLCHAIN_FILE=$root/tests/cross/$1.cmake" -DCMAKE_BUILD_TYPE=Cross \
        "-DCMAKE_C_FLAGS_CROSS=$3" -DGSFIXER_EXAMPLES=OFF -DGSFIXER_BENCH=OFF "-DGSFIXER_TEST_PREFIX=$1." \
        "-DGSFIXER_TEST_ONLY=$4" "-DGSFIXER_HOST_TESTS=$build/tests"
}
cross_tree windows x86_64-w64-mingw32-gcc "-O1$narrow" "$core"
cross_tree arm aarch64-linux-gnu-gcc -O2 "$([ -n "${GSF_ARM_ALL:-}" ] || echo "$kernels")"
cross_tree web emcc -O2 "$kernels"
build_trees
# Makes Wine's settings, and starts its services once for all tests: those that a test started would keep ctest waiting for the
# end of its output as long as any other test ran.
if [ -d "$build/windows" ]; then
    wineserver=$(command -v wineserver || ls /usr/lib/wine/wineserver64)
    mkdir -p "$WINEPREFIX"
    "$wineserver" -p
    trap '"$wineserver" -k' EXIT
    step wine "$root/tests/cross/wine.sh" cmd /c exit
fi

{ printf 'subdirs('; printf '"%s" ' "${trees[@]}"; printf ')\n'; } > "$build/all/CTestTestfile.cmake"
say "built after $((SECONDS - started)) s; testing"
export OMP_WAIT_POLICY=passive # several programs share the cores
export ASAN_OPTIONS=${ASAN_OPTIONS:-detect_stack_use_after_return=1:allocator_may_return_null=1:handle_sigill=1}
status=0
(cd "$build/all" && ctest --output-on-failure --parallel "$jobs" "$@") > >(tee "$build/all/ctest.log") 2>&1 || status=$?
wait
exit "$status"
