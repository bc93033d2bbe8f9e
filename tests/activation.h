// The activations of gsfixer_nn.h in double. Included after it.
#ifndef ACTIVATION_H
#define ACTIVATION_H

#include <math.h>

static double activation_of(gsf__nn_activation activation, double x) {
    switch (activation) {
        case GSF__NN_LINEAR: return x;
        case GSF__NN_GELU_TANH: return 0.5 * x * (1.0 + tanh(0.7978845608028654 * (x + 0.044715 * x * x * x)));
        case GSF__NN_SILU: return x / (1.0 + exp(-x));
        case GSF__NN_GELU: return 0.5 * x * erfc(-x / sqrt(2.0));
        case GSF__NN_RELU: return x < 0.0 ? 0.0 : x;
        case GSF__NN_QUICK_GELU: return x / (1.0 + exp(-1.702 * x));
    }
    return NAN; // not added here yet
}

#endif
