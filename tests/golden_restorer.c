// The restorer against golden data of the GSFixer release: every part reads its shapes, configs and values from
// GSF_GOLDEN/restorer, so that another folder with the same layout passes unchanged. GSF_TEST_VERBOSE=1 prints every
// error.
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "restorer_golden.h"
#include "restorer_linear.h"
#include "restorer_numerics.h"
#include "restorer_pipeline.h"
#include "restorer_scheduler.h"
#include "restorer_t5.h"
#include "restorer_tables.h"
#include "restorer_tokenizer.h"
#include "restorer_transformer.h"
#include "restorer_vae.h"

int main(void) {
    check_linear();
    check_numerics();
    check_scheduler();
    check_tables();
    check_vae();
    check_tokenizer();
    check_t5();
    check_transformer();
    check_pipeline();
    return test_report();
}
