#!/usr/bin/env bash
# same_bits.sh HOST-PROGRAM COMMAND...: test_platforms trains to the same bits, here and by COMMAND.
set -euo pipefail
host=$1
shift
[ -x "$host" ] || { echo "SKIPPED: $host is not there"; exit 77; }
here=$("$host" digest) there=$("$@" digest | tr -d '\r')
echo "$here"
[ -n "$here" ] && [ "$here" = "$there" ] || { echo "FAILED: $there by $*"; exit 1; }
