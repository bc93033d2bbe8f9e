// The image encoders and the captioner against golden data of the GSFixer release: every part reads its shapes, configs
// and values from GSF_GOLDEN/encoders, so that another folder with the same layout passes unchanged. GSF_TEST_VERBOSE=1
// prints every error.
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "encoders_golden.h"
#include "encoders_blip2.h"
#include "encoders_dinov2.h"
#include "encoders_preprocess.h"
#include "encoders_vggt.h"

int main(void) {
    check_preprocess();
    check_dinov2();
    check_vggt();
    check_blip2();
    return test_report();
}
