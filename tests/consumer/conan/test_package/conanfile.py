"""The project of tests/consumer, with the package that was made."""
import os

from conan import ConanFile
from conan.tools.cmake import CMake, cmake_layout


class Consumer(ConanFile):
    settings = "os", "arch", "compiler", "build_type"
    generators = "CMakeToolchain", "CMakeDeps"

    def requirements(self):
        self.requires(self.tested_reference_str)

    def layout(self):
        cmake_layout(self)

    def build(self):
        cmake = CMake(self)
        cmake.configure(variables={"WAY": "find_package"}, build_script_folder=os.environ["GSFIXER_CONSUMER"])
        cmake.build()

    def test(self):
        self.run(os.path.join(self.cpp.build.bindir, "consumer"), env="conanrun")
