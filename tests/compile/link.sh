#!/usr/bin/env bash
# link.sh COMPILER STANDARD: modules compiled in separate translation units link with a caller in the other language,
# private copies (GSFIXER_STATIC) live side by side, and every declared function is defined.
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"

link() { # NAME SOURCE...: compiles by extension, links, runs
    local name=$1 objects=() source
    shift
    count=$((count + 1))
    for source in "$@"; do
        case $source in
            *.c) "$c_compiler" -std=c11 -I"$root" -c "$work/$source" -o "$work/$source.o" ;;
            *.cpp) "$cxx" -std=c++17 -I"$root" -c "$work/$source" -o "$work/$source.o" ;;
        esac > "$work/log" 2>&1 || { failed "$name ($source)" "$work/log"; return; }
        objects+=("$work/$source.o")
    done
    "$cxx" "${objects[@]}" -o "$work/program" -lm > "$work/log" 2>&1 || { failed "$name" "$work/log"; return; }
    "$work/program" > "$work/log" 2>&1 || { echo "exit status $?" >> "$work/log"; failed "$name (run)" "$work/log"; }
}
case $compiler in
    gcc) c_compiler=gcc cxx=g++ ;;
    clang) c_compiler=${cc/++/} cxx=${c_compiler/clang/clang++} ;;
esac
other=$([ "$ext" = c ] && echo cpp || echo c)

# A caller that uses something of the ground and of a module.
cat > "$work/caller.$other" <<'TEXT'
#include "gsfixer_splat.h"
#include "gsfixer_traj.h"
#include <string.h>
int main(void) {
    gsf_context ctx;
    gsf_splats splats;
    memset(&ctx, 0, sizeof ctx);
    if (gsf_init_context(&ctx) != GSF_OK || gsf_splat_make(&ctx, 2, 1, &splats) != GSF_OK) return 1;
    gsf_splat_destroy(&ctx, &splats);
    return 0;
}
TEXT
parts=()
for header in "${headers[@]}"; do
    printf '#define %s\n#include "%s.h"\n' "$(implementation_of "$header")" "$header" > "$work/$header.$ext"
    parts+=("$header.$ext")
done
link "one translation unit per module" "${parts[@]}" "caller.$other"

{ echo "#define GSFIXER_IMPLEMENTATION"; printf '#include "%s.h"\n' "${headers[@]}"; } > "$work/whole.$ext"
link "the two-line file" "whole.$ext" "caller.$other"

c_linkage=$([ "$ext" = c ] || echo 'extern "C"')
for file in one two; do
    {
        printf '#define GSFIXER_STATIC\n#define GSFIXER_IMPLEMENTATION\n'
        printf '#include "%s.h"\n' "${headers[@]}"
        echo "$c_linkage const char* one(void);"
        echo "$c_linkage const char* two(void);"
        echo "const char* $file(void) { return gsf_describe_result(GSF_OK); }"
        [ $file = two ] || echo 'int main(void) { return one() == 0 || two() == 0; }'
    } > "$work/$file.$ext"
done
link "GSFIXER_STATIC in two files" "one.$ext" "two.$ext"

# Every function that a header declares (the text before "The API ends here") is defined somewhere.
{
    printf '#include "%s.h"\n' "${headers[@]}"
    echo 'typedef void (*any_function)(void);'
    echo 'extern any_function const every_function[];'
    echo 'any_function const every_function[] = {'
    for header in "${headers[@]}"; do
        sed '/The API ends here/,$d' "$root/$header.h" | grep -v '^ *//' | tr '\n' ' ' | grep -oE 'GSF_API [^;{}]*\(' |
            grep -oE 'gsf_[a-z0-9_]+ *\(' | sed 's/ *($//; s/(//' | sort -u | sed 's/.*/    (any_function)&,/'
    done
    echo '};'
    echo 'int main(void) { return every_function[0] == 0; }'
} > "$work/symbols.c"
symbols=$(grep -c any_function\) "$work/symbols.c")
[ "$symbols" -gt 50 ] || { echo "only $symbols declared functions found"; failures=$((failures + 1)); }
link "all $symbols declared functions are defined" "whole.$ext" symbols.c
finish
