#!/usr/bin/env bash
# link.sh COMPILER STANDARD: modules compiled in separate translation units link with a caller in the other language,
# private copies (GSFIXER_STATIC) live side by side, every declared function is defined, and what GSF_NO_STB leaves works.
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"

link() { # NAME SOURCE...: compiles by extension, unless that was done before, links, runs
    local name=$1 objects=() source
    shift
    count=$((count + 1))
    for source in "$@"; do
        objects+=("$work/$source.o")
        [ ! -e "$work/$source.o" ] || continue
        case $source in
            *.c) "$c_compiler" -std=c11 -I"$root" -c "$work/$source" -o "$work/$source.o" ;;
            *.cpp) "$cxx" -std=c++17 -I"$root" -c "$work/$source" -o "$work/$source.o" ;;
        esac > "$work/log" 2>&1 || { failed "$name ($source)" "$work/log"; return; }
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

# Without stb: .spz and photos are not read, in a sentence; the other formats work, .spz and PNG are written.
cat > "$work/no_stb.$ext" <<'TEXT'
#define GSF_NO_STB
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h"
static int unsupported(gsf_context* ctx, gsf_result result) {
    return result == GSF_ERROR_UNSUPPORTED && strncmp(ctx->error, "a.spz: ", 7) == 0 && strstr(ctx->error, "GSF_NO_STB");
}
int main(void) {
    static const unsigned char spz[] = {31, 139, 8, 0, 0, 0, 0, 0, 0, 3, 3, 0, 0, 0, 0, 0, 16, 0, 0, 0};
    static const char* const names[2] = {"a.ply", "a.splat"};
    gsf_context ctx;
    gsf_splats splats, again;
    gsf_buffer text;
    memset(&ctx, 0, sizeof ctx);
    memset(&text, 0, sizeof text);
    if (gsf_init_context(&ctx) != GSF_OK || gsf_splat_make(&ctx, 2, 1, &splats) != GSF_OK) return 1;
    if (!unsupported(&ctx, gsf_splat_parse(&ctx, "a.spz", spz, sizeof spz, &again)) || again.owned) return 2;
    if (gsf_splat_format(&ctx, "a.spz", &splats, NULL, &text) != GSF_OK || text.size < 20) return 3;
    unsigned char pixel[3] = {1, 2, 3};
    const gsf_image image = gsf_wrap_image(pixel, GSF_U8, 1, 1, 3);
    if (gsf_encode_image(&ctx, &image, ".png", &text) != GSF_OK) return 6;
    if (gsf_encode_image(&ctx, &image, ".jpg", &text) != GSF_ERROR_UNSUPPORTED) return 7;
    for (int i = 0; i < 2; i++) {
        text.size = 0;
        if (gsf_splat_format(&ctx, names[i], &splats, NULL, &text) != GSF_OK) return 4;
        if (gsf_splat_parse(&ctx, names[i], text.data, text.size, &again) != GSF_OK || again.count != 2) return 5;
        gsf_splat_destroy(&ctx, &again);
    }
    gsf_destroy_buffer(&ctx, &text);
    gsf_splat_destroy(&ctx, &splats);
    return 0;
}
TEXT
link "GSF_NO_STB" "no_stb.$ext"

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
