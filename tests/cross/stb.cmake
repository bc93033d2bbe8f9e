# stb's headers are the machine's own, and the only ones of it that a cross compiler may see.
set(CMAKE_FIND_ROOT_PATH "/nowhere")
set(CMAKE_FIND_ROOT_PATH_MODE_PROGRAM NEVER)
set(CMAKE_FIND_ROOT_PATH_MODE_LIBRARY ONLY)
set(CMAKE_FIND_ROOT_PATH_MODE_INCLUDE ONLY)
file(MAKE_DIRECTORY "${CMAKE_BINARY_DIR}/include")
file(CREATE_LINK /usr/include/stb "${CMAKE_BINARY_DIR}/include/stb" SYMBOLIC)
set(CMAKE_C_FLAGS_INIT "${CMAKE_C_FLAGS_INIT} -isystem \"${CMAKE_BINARY_DIR}/include\"")
