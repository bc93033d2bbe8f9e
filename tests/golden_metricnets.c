// The networks of the metrics against GSF_GOLDEN/metricnets, from which every part reads its files, shapes and values, so
// that another folder with the same layout passes unchanged. GSF_TEST_VERBOSE=1 prints every error.
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "test.h"
#include "test_hooks.h"

#include "metricnets_golden.h"
#include "metricnets_amt.h"
#include "metricnets_i2v.h"
#include "metricnets_pth.h"
#include "metricnets_viclip.h"

int main(void) {
    check_pth();
    check_dino();
    check_dreamsim();
    check_amt();
    check_viclip();
    return test_report();
}
