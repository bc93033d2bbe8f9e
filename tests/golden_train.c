// golden_train.c - loss, Adam, learning rates, densification against the golden data.
// gcc -O2 -std=c11 -I. -Itests tests/golden_train.c -lm
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h"
#include "test.h"
#include "train_golden.h"

int main(void) {
    train_golden_checks();
    return test_report();
}
