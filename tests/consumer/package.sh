#!/usr/bin/env bash
# package.sh SCRATCH: the recipes for package managers, from a tarball of the tree. Without vcpkg (VCPKG_ROOT) the steps of its
# port are done by hand, with what the port passes to CMake, except for vcpkg_cmake_config_fixup, which moves the package. conan
# (of PyPI, version 2) is used where it is in PATH.
set -euo pipefail
scratch=$1
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
rm -rf "$scratch"
mkdir -p "$scratch/tree"
scratch=$(cd "$scratch" && pwd)
# As `git archive --prefix=gsfixer-0.2.0/ HEAD`, but with what is not committed yet, and where there is no git.
version=$(sed -n 's/^#define GSF_VERSION "\(.*\)"/\1/p' "$here/../../gsfixer.h")
(cd "$here/../.." && tar --exclude=./build --exclude=./.git --transform "s,^\.,gsfixer-$version," -czf "$scratch/gsfixer.tar.gz" .)
export GSFIXER_TARBALL=$scratch/gsfixer.tar.gz GSFIXER_CONSUMER=$here
fail() { echo "FAILED: $*"; exit 1; }
for recipe in vcpkg/gsfixer/vcpkg.json conan/conanfile.py; do
    grep -q "version\"\?[:= ]*\"$version\"" "$here/$recipe" || fail "$recipe is of another version than $version"
done

if [ -x "${VCPKG_ROOT:-}/vcpkg" ]; then
    VCPKG_KEEP_ENV_VARS=GSFIXER_TARBALL "$VCPKG_ROOT/vcpkg" install gsfixer --overlay-ports="$here/vcpkg" \
        --x-install-root="$scratch/vcpkg" > "$scratch/log" 2>&1 || { cat "$scratch/log"; fail "vcpkg"; }
    prefix=$(dirname "$(find "$scratch/vcpkg" -name include -type d | head -n 1)")
else
    port=$here/vcpkg/gsfixer/portfile.cmake
    read -r -a options <<< "$(sed -n 's/^    OPTIONS \(.*\))$/\1/p' "$port")"
    config=$(sed -n 's/.*CONFIG_PATH \(.*\))$/\1/p' "$port")
    prefix=$scratch/prefix
    tar -xzf "$GSFIXER_TARBALL" -C "$scratch/tree" --strip-components=1
    { cmake -S "$scratch/tree" -B "$scratch/made" "${options[@]}" -DCMAKE_BUILD_TYPE=Release "-DCMAKE_INSTALL_PREFIX=$prefix" &&
        cmake --build "$scratch/made" && cmake --install "$scratch/made"; } > "$scratch/log" 2>&1 ||
        { cat "$scratch/log"; fail "the steps of the port"; }
    [ -f "$prefix/$config/gsfixer-config.cmake" ] || fail "no package in $config, where the port looks for it"
    [ -f "$scratch/tree/LICENSE" ] || fail "no LICENSE"
    echo "vcpkg's port: its steps, by hand"
fi
{ cmake -S "$here" -B "$scratch/consumer" -DWAY=find_package "-DCMAKE_PREFIX_PATH=$prefix" &&
    cmake --build "$scratch/consumer" && "$scratch/consumer/consumer"; } > "$scratch/log" 2>&1 ||
    { cat "$scratch/log"; fail "a project with the package of the port"; }

if command -v conan > /dev/null; then
    export CONAN_HOME=$scratch/conan
    { conan profile detect && conan create "$here/conan" --build=missing --no-remote \
        -c "tools.cmake.cmake_layout:test_folder=$scratch/test"; } > "$scratch/log" 2>&1 ||
        { tail -n 60 "$scratch/log"; fail "conan create"; }
    echo "conan's recipe: made, and used by a project"
fi
