#!/usr/bin/env bash
# wine.sh PROGRAM.exe ARGUMENT...: runs it without a display and without Wine's own messages. WINEPREFIX: see run.sh.
export WINEDEBUG=${WINEDEBUG:--all} WINEDLLOVERRIDES="mscoree,mshtml,winemenubuilder.exe="
unset DISPLAY WAYLAND_DISPLAY
# The DLLs of MinGW: OpenMP and its threads.
export WINEPATH="$(dirname "$(x86_64-w64-mingw32-gcc -print-file-name=libgomp-1.dll)");/usr/x86_64-w64-mingw32/lib${WINEPATH:+;$WINEPATH}"
wine=$(command -v wine64 || ls /usr/lib/wine/wine64 2> /dev/null || command -v wine)
exec "$wine" "$@"
