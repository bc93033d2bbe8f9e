#!/usr/bin/env bash
# examples/web/build.sh [FOLDER]: builds the page with Emscripten (Debian: emscripten, libstb-dev) into FOLDER (build/page).
#   python3 examples/web/serve.py build/page     and open http://localhost:8000
# Two modules: with threads for pages that are isolated from other origins, as serve.py's are, and without for all others.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
out=${1:-$here/../../build/page}
mkdir -p "$out/include"
[ -e "$out/include/stb" ] || ln -s "${STB_INCLUDE:-/usr/include/stb}" "$out/include/stb"
export NODE_PATH=${NODE_PATH:-/usr/share/nodejs:/usr/lib/nodejs} # Debian's acorn, which emcc needs, whatever node is first in PATH
# The kernels are written with vectors; what the compiler would unroll and vectorize on its own makes the module a third larger.
kernels=(-O2 -fno-unroll-loops -fno-vectorize -fno-slp-vectorize -finline-hint-functions -DGSFIXER_IMPLEMENTATION)
common=(-std=gnu11 -msimd128 -I"$here/../.." -isystem "$out/include" -Wall -Wextra)
link=(-sMODULARIZE=1 -sEXPORT_NAME=makeGsfixer -sENVIRONMENT=worker -sFILESYSTEM=0 -sALLOW_MEMORY_GROWTH=1 -sMAXIMUM_MEMORY=2GB
    -sTOTAL_STACK=1MB -sDEFAULT_PTHREAD_STACK_SIZE=256KB -sEXPORTED_FUNCTIONS=_malloc,_free -Wno-pthreads-mem-growth
    -sEXPORTED_RUNTIME_METHODS=stringToUTF8,lengthBytesUTF8,UTF8ToString)
build() { # NAME [THREADS]; nothing to do if the module is newer than its sources
    local threads=${2:+-pthread} pool=()
    if [ -n "$threads" ]; then pool=("-sPTHREAD_POOL_SIZE=Math.min(navigator.hardwareConcurrency,8)-1"); fi
    if [ "$out/$1.wasm" -nt "$here/build.sh" ] && [ -z "$(find "$here" "$here/.." "$here/../.." -maxdepth 1 -name '*.[ch]' \
        -newer "$out/$1.wasm" -print -quit)" ]; then return; fi
    emcc "${common[@]}" $threads "${kernels[@]}" -x c "$here/../../gsfixer_splat.h" -c -o "$out/$1.o"
    emcc "${common[@]}" $threads -Oz -Wno-unused-function "$here/web.c" -c -o "$out/$1.web.o"
    emcc $threads "${link[@]}" "${pool[@]}" -O2 "$out/$1.o" "$out/$1.web.o" -o "$out/$1.js"
    rm "$out/$1.o" "$out/$1.web.o"
}
build gsfixer
build gsfixer_threads threads
cp "$here/index.html" "$here/page.js" "$out"
