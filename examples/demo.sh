#!/usr/bin/env bash
# examples/demo.sh: the complete job on a generated scene; leaves build/demo/report.html.
# Installs what is missing with apt-get (as root or by sudo), builds gsfix and the scene generator, ray-traces a small
# courtyard into 40 photos with a COLMAP model, trains splats on 3 of them with repair, and also without,
# so that the report shows what the repair alone gains. Less than three minutes on two cores. GSF_BUILD=folder builds
# elsewhere than in build/.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
out=${GSF_BUILD:-build}/demo
started=$SECONDS
say() { printf '== %s\n' "$*"; }

install_missing() {
    command -v dpkg-query > /dev/null || { say "no dpkg here: cmake, make, gcc, Embree and stb have to be there"; return; }
    local missing=() package
    for package in cmake make gcc libc6-dev libembree-dev libstb-dev; do
        [ "$(dpkg-query -W -f '${db:Status-Status}' "$package" 2> /dev/null || true)" = installed ] || missing+=("$package")
    done
    [ ${#missing[@]} -gt 0 ] || return 0
    say "installing ${missing[*]}"
    local as_root=()
    if [ "$(id -u)" != 0 ]; then
        command -v sudo > /dev/null || { echo "$0: not root and no sudo; install by hand: ${missing[*]}" >&2; exit 1; }
        as_root=(sudo)
    fi
    "${as_root[@]}" apt-get update -q
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends "${missing[@]}"
}

quietly() { # COMMAND...: its output is shown only if it fails
    "$@" > "$out/build.log" 2>&1 || { tail -n 40 "$out/build.log" >&2; echo "$0: failed: $*" >&2; exit 1; }
}

install_missing
[ $((SECONDS - started)) -lt 2 ] || started=$SECONDS # what follows is the demo's own time
mkdir -p "$out"

say "building gsfix and make_scene"
quietly cmake -S . -B "$out/tree" -DCMAKE_BUILD_TYPE=Release -DGSFIXER_TESTS=OFF -DGSFIXER_BENCH=OFF -DGSFIXER_INSTALL=OFF
quietly cmake --build "$out/tree" --parallel 2 --target gsfix --target make_scene

say "ray-tracing a scene"
"$out/tree/make_scene" "$out/scene" --views 40 --width 320 --height 240

export OMP_WAIT_POLICY=passive # idle workers must not occupy the cores
say "training on 3 of 40 photos without repair, then with it"
"$out/tree/gsfix" fix "$out/scene" --out "$out" --restart --views 3 --restorer mini --compare --iterations 900

say "$((SECONDS - started)) s in all; open $out/report.html"
