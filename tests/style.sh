#!/usr/bin/env bash
# style.sh: the rules of .clang-format that can be checked without clang-format: no line of C or C++ longer than its
# ColumnLimit (except lines that begin with a string literal, and gsfix_report.c, an HTML page in such literals), no tabs,
# no trailing blanks, a newline at the end of each file.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
limit=$(sed -n 's/^ColumnLimit: //p' .clang-format)
[ -n "$limit" ] || { echo "style.sh: .clang-format has no ColumnLimit" >&2; exit 1; }
sources=(*.h {examples,examples/web,bench,tests,tests/compile}/*.[ch] {examples,tests}/*.cpp)
others=(*.md CMakeLists.txt {examples,tests}/CMakeLists.txt {examples,examples/web,bench,tests,tests/compile}/*.sh bench/*.py tests/*.py examples/web/*.{py,js,html})
status=0
for file in "${sources[@]}" "${others[@]}"; do
    [ -e "$file" ] || continue
    [ -z "$(tail -c 1 "$file")" ] || { echo "$file: no newline at the end"; status=1; }
done
LC_ALL=C.UTF-8 awk -v limit="$limit" '
    function fault(what) { print FILENAME ":" FNR ": " what; bad = 1 }
    /\t/ { fault("a tab") }
    /[ \r]$/ && FILENAME !~ /\.md$/ { fault("blanks at the end") }
    length($0) > limit && FILENAME ~ /\.(h|c|cpp)$/ && FILENAME != "examples/gsfix_report.c" && !/^ *"/ {
        fault(length($0) " columns, more than " limit)
    }
    END { exit bad }' $(ls "${sources[@]}" "${others[@]}" 2> /dev/null) || status=1
exit $status
