// The headers after names that platforms' headers define as macros: none of them is an identifier of ours. On Windows, after
// the platform's own.
#ifdef _WIN32
#include <winsock2.h>
#include <windows.h> // whole: with rpcndr.h, wingdi.h and min, max
#else
#define small char
#define near
#define far
#define interface struct
#define hyper long long
#define pascal
#define cdecl
#define IN
#define OUT
#define ERROR 0
#define NEAR near
#define FAR far
#define min(a, b) ((a) < (b) ? (a) : (b))
#define max(a, b) ((a) > (b) ? (a) : (b))
#define minor(device) (device)
#define major(device) (device)
#define Status int
#define Success 0
#define None 0L
#define Bool int
#define True 1
#define False 0
#define Always 2
#define check(x) ((void)(x))
#define verify(x) ((void)(x))
#define CONST const
#define VOID void
#define TEXT(x) L##x
#define POINTS int
#define DELETE 1
#define READ_CONTROL 2
#define STRICT
#define OPAQUE 2
#define TRANSPARENT 1
#define rad1 4
#define grp1 5
#endif

#define GSFIXER_IMPLEMENTATION
#define GSF_NO_STB // not ours
#define GSF_NN_TRAINING
#include "gsfixer_nn.h"
#include "gsfixer_splat.h"

#include "test.h"

int main(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    CHECK(strcmp(gsf_describe_result(GSF_OK), "ok") == 0);
    return test_report();
}
