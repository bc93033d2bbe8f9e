# An overlay port: vcpkg install gsfixer --overlay-ports=tests/consumer/vcpkg
# GSFIXER_TARBALL (in the environment, listed in VCPKG_KEEP_ENV_VARS) is a tarball of the tree, as `git archive` makes it.
set(VCPKG_BUILD_TYPE release) # headers only
vcpkg_extract_source_archive(SOURCE_PATH ARCHIVE "$ENV{GSFIXER_TARBALL}")
vcpkg_cmake_configure(SOURCE_PATH "${SOURCE_PATH}"
    OPTIONS -DGSFIXER_EXAMPLES=OFF -DGSFIXER_TESTS=OFF -DGSFIXER_BENCH=OFF)
vcpkg_cmake_install()
vcpkg_cmake_config_fixup(CONFIG_PATH share/cmake/gsfixer)
vcpkg_install_copyright(FILE_LIST "${SOURCE_PATH}/LICENSE")
