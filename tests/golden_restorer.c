// The restorer against the golden data of the official code: every part reads its shapes, configs and values from
// GSF_GOLDEN/restorer, so that another folder of the same layout passes unchanged.
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "test.h"

#include "restorer_scheduler.h"
#include "restorer_tables.h"

int main(void) {
    check_scheduler();
    check_tables();
    return test_report();
}
