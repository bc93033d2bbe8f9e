"""A recipe for Conan 2:  conan create tests/consumer/conan
The environment's GSFIXER_TARBALL is a tarball of the tree, as `git archive` makes it. The test package is tests/consumer."""
import os

from conan import ConanFile
from conan.tools.cmake import CMake, CMakeToolchain
from conan.tools.files import copy, unzip


class Gsfixer(ConanFile):
    name = "gsfixer"
    version = "0.2.0"
    license = "MIT"
    description = "Repairs 3D Gaussian Splatting scenes made from few photos; headers in C11"
    package_type = "header-library"
    settings = "os", "arch", "compiler", "build_type"
    no_copy_source = True

    def source(self):
        unzip(self, os.environ["GSFIXER_TARBALL"], self.source_folder, strip_root=True)

    def generate(self):
        toolchain = CMakeToolchain(self)
        for part in ("EXAMPLES", "TESTS", "BENCH"):
            toolchain.cache_variables["GSFIXER_" + part] = False
        toolchain.generate()

    def package(self):
        cmake = CMake(self)
        cmake.configure()
        cmake.install()
        copy(self, "LICENSE", self.source_folder, os.path.join(self.package_folder, "licenses"))

    def package_id(self):
        self.info.clear()

    def package_info(self):
        # The package's own gsfixer-config.cmake is used, which has the target gsfixer::gsfixer.
        self.cpp_info.bindirs = self.cpp_info.libdirs = []
        self.cpp_info.builddirs = ["share/cmake/gsfixer"]
        self.cpp_info.set_property("cmake_find_mode", "none")
        if self.settings.get_safe("os") not in (None, "Windows"):
            self.cpp_info.system_libs = ["m"]
