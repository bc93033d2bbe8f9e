# Sourced by headers.sh and link.sh with COMPILER (gcc, clang) and STANDARD (c11, c++17) as $1 and $2.
# Sets: root, headers (names without .h), cc, ext, flags (those of every header), work (an empty folder, removed at exit).
set -u
shopt -s lastpipe # so that a function at the end of a pipe can count
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
compiler=$1 standard=$2
case $compiler:$standard in
    gcc:c11) cc=gcc ext=c ;;
    gcc:c++17) cc=g++ ext=cpp ;;
    clang:c11) cc=clang ext=c ;;
    clang:c++17) cc=clang++ ext=cpp ;;
    *) echo "usage: $0 gcc|clang c11|c++17" >&2; exit 2 ;;
esac
command -v "$cc" > /dev/null || [ "$compiler" = gcc ] || cc+=-14 # Debian has clang-14 without the plain name
command -v "$cc" > /dev/null || { echo "no $cc here"; exit 77; }
flags=(-std="$standard" -Wall -Wextra -Wpedantic -Wconversion -Wshadow -Werror -I"$root")
[ "$ext" = c ] && flags+=(-Wstrict-prototypes)
headers=()
for file in "$root"/gsfixer*.h; do file=${file##*/}; headers+=("${file%.h}"); done
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
failures=0 count=0

# Name of the macro that emits one module.
implementation_of() {
    if [ "$1" = gsfixer ]; then echo GSFIXER_BASE_IMPLEMENTATION; else echo "${1^^}_IMPLEMENTATION"; fi
}

# Can this header be found?
have_include() {
    echo "#include <$1>" > "$work/have.$ext"
    "$cc" -std="$standard" -E "$work/have.$ext" > /dev/null 2>&1
}

failed() { # NAME LOG
    echo "FAILED $1"
    grep -m 5 -E 'error|warning|undefined|multiple' "$2" || tail -n 5 "$2"
    failures=$((failures + 1))
}

finish() {
    echo "$count checks with $cc -std=$standard, $failures failed"
    [ "$failures" = 0 ]
    exit
}
