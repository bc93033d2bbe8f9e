#!/usr/bin/env bash
# headers.sh COMPILER STANDARD: every header alone, in every order (gcc: C, clang: C++), declared and implemented, and every
# configuration compiles without a warning. Syntax only.
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"

unit() { # NAME FLAG... ; the unit's text on stdin
    local name=$1
    shift
    { cat; echo "int test_unit_$count;"; } > "$work/unit.$ext"
    count=$((count + 1))
    "$cc" "${flags[@]}" "$@" -fsyntax-only "$work/unit.$ext" > "$work/log" 2>&1 && [ ! -s "$work/log" ] ||
        failed "$name" "$work/log"
}

permutations() { # PREFIX ITEM...: one line per order of the items
    local prefix=$1 i
    shift
    if [ $# = 0 ]; then echo "$prefix"; return; fi
    for ((i = 1; i <= $#; i++)); do
        permutations "$prefix ${*:i:1}" "${@:1:i-1}" "${@:i+1}"
    done
}

include_all() { for header in "$@"; do echo "#include \"$header.h\""; done; }

for header in "${headers[@]}"; do
    include_all "$header" | unit "$header"
    { echo "#define $(implementation_of "$header")"; include_all "$header"; } | unit "$header, own implementation"
    { include_all "$header"; echo "#define GSFIXER_IMPLEMENTATION"; include_all "$header" "$header"; } |
        unit "$header declared, then implemented, then included again"
    for other in "${headers[@]}"; do
        [ "$other" = "$header" ] || include_all "$header" "$other" | unit "$header, $other"
    done
done
# What depends on the order does so for every compiler: each language is tried by one. Every module begins with gsfixer.h, so
# that its place among them makes no other text.
modules=()
for header in "${headers[@]}"; do
    [ "$header" = gsfixer ] && continue
    modules+=("$header")
    [ "$(grep -m 1 '^#include "' "$root/$header.h")" = '#include "gsfixer.h"' ] || { echo "$header: not gsfixer.h first"; exit 1; }
done
case $compiler:$standard in
    gcc:c11 | clang:c++17) orders=$(permutations "" "${modules[@]}") ;;
    *) orders="${modules[*]}" ;;
esac
while read -r order; do
    # shellcheck disable=SC2086
    { echo "#define GSFIXER_IMPLEMENTATION"; include_all $order; } | unit "implementation in order: $order"
done <<< "$orders"

whole() { echo "#define GSFIXER_IMPLEMENTATION"; include_all "${headers[@]}"; }
whole | unit "NDEBUG" -DNDEBUG
whole | unit "GSF_NO_SIMD" -DGSF_NO_SIMD
whole | unit "GSF_NO_AVX512" -DGSF_NO_AVX512
whole | unit "GSF_NO_STB" -DGSF_NO_STB
whole | unit "GSFIXER_STATIC" -DGSFIXER_STATIC
whole | unit "GSF_NN_TRAINING" -DGSF_NN_TRAINING
if [ "$compiler" = gcc ] || have_include omp.h; then whole | unit "OpenMP" -fopenmp; fi
if have_include embree4/rtcore.h || have_include embree3/rtcore.h; then
    whole | unit "GSF_USE_EMBREE" -DGSF_USE_EMBREE
fi
if [ "$ext" = cpp ]; then
    if have_include glm/glm.hpp; then
        whole | unit "GSF_USE_GLM" -DGSF_USE_GLM
        include_all "${headers[@]}" | unit "GSF_USE_GLM, declarations" -DGSF_USE_GLM
    fi
    if have_include OpenImageIO/imageio.h; then whole | unit "GSF_USE_OIIO" -DGSF_USE_OIIO; fi
fi
finish
