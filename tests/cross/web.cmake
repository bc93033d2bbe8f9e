# WebAssembly with SIMD128 by Emscripten; programs run in node, on the machine's files. Newer nodes have a fetch that does not
# take paths, which Emscripten 3.1.6 would use.
include(/usr/share/emscripten/cmake/Modules/Platform/Emscripten.cmake)
set(CMAKE_CROSSCOMPILING_EMULATOR node --no-experimental-fetch)
set(CMAKE_C_FLAGS_INIT "-msimd128")
set(CMAKE_EXE_LINKER_FLAGS_INIT "-sALLOW_MEMORY_GROWTH=1 -sNODERAWFS=1 -sTOTAL_STACK=1048576")
include("${CMAKE_CURRENT_LIST_DIR}/stb.cmake")
