#!/usr/bin/env bash
# platforms.sh: the headers compile without a warning for other platforms and under stricter rules, where the compilers are
# installed: MinGW (after windows.h), 64-bit Arm, WebAssembly, tcc (which has no extensions of GCC), C++20, and without
# conversions from float to double that nobody wrote. Syntax only.
set -uo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
ln -s /usr/include/stb "$work/stb"
failures=0 tried=0
{
    printf '#ifdef _WIN32\n#include <windows.h>\n#endif\n#define GSFIXER_IMPLEMENTATION\n#define GSF_NN_TRAINING\n'
    for header in "$root"/gsfixer*.h; do printf '#include "%s"\n' "${header##*/}"; done
    printf 'int test_unit;\n'
} > "$work/unit.c"
cp "$work/unit.c" "$work/unit.cpp"
check() { # COMPILER FLAG...
    command -v "$1" > /dev/null || { echo "no $1 here"; return; }
    tried=$((tried + 1))
    "$@" -I"$root" -isystem "$work" > "$work/log" 2>&1 && [ ! -s "$work/log" ] && return
    failures=$((failures + 1))
    echo "FAILED: $*"
    head -n 20 "$work/log"
}
warnings=(-Wall -Wextra -Wpedantic -Wconversion -Wshadow -Werror -fsyntax-only)
long=-flarge-source-files # else gcc notes that it cannot tell misleading indentation in so long a unit
cd "$work"
check gcc -std=c11 "${warnings[@]}" -Wdouble-promotion unit.c
check g++ -std=c++20 "${warnings[@]}" unit.cpp
check clang++-14 -std=c++20 "${warnings[@]}" unit.cpp
check x86_64-w64-mingw32-gcc -std=c11 "${warnings[@]}" $long unit.c
check x86_64-w64-mingw32-gcc -std=gnu17 "${warnings[@]}" $long unit.c
check x86_64-w64-mingw32-g++ -std=c++17 "${warnings[@]}" $long unit.cpp
check aarch64-linux-gnu-gcc -std=c11 "${warnings[@]}" unit.c
check aarch64-linux-gnu-g++ -std=c++17 "${warnings[@]}" unit.cpp
check clang-14 --target=aarch64-linux-gnu -std=c11 "${warnings[@]}" -isystem /usr/aarch64-linux-gnu/include unit.c
check emcc -std=c11 -msimd128 "${warnings[@]}" unit.c
check emcc -std=c11 "${warnings[@]}" unit.c
if command -v tcc > /dev/null; then # has no -isystem for folders of links
    tried=$((tried + 1))
    tcc -std=c11 -Wall -Werror -c -I"$root" -I"$work" unit.c -o unit.o > log 2>&1 && [ ! -s log ] ||
        { failures=$((failures + 1)); echo "FAILED: tcc"; head -n 20 log; }
fi
[ $failures = 0 ] && [ $tried -ge 3 ] || exit 1
echo "$tried compilers"
