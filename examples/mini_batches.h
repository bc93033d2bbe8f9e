// mini_batches.h - batches of augmented crops from the files of mini_data.h. Part of train_mini.c.
// SPDX-License-Identifier: MIT
/* Sample b of step t depends on the seed, t and b only. Augmentations act on all planes of a crop alike: mirrored, transposed,
   channels of colours in another order, less or more saturated, another gamma and exposure. Some hide evidence: references that
   show nothing, or nothing by one of the two ways; holes in the render. Others make the input better than splats of few photos
   are, if asked for: a share of the renders is partly the truth, so that the network sees pixels which it must leave alone. */
#ifndef MINI_BATCHES_H
#define MINI_BATCHES_H

enum { BATCH_DRAWS = 64, BATCH_TABLE = 1024 };

typedef struct mini_sample { float *frame, *shown, *truth; } mini_sample; // of a crop, as in gsf__mini_input

typedef struct mini_batch {
    const gsf_nn_tensor* const* scenes; // "frames" of each
    size_t scene_count;
    int64_t crop, count, step;          // count: samples of a batch
    size_t first;                       // the sample of the batch that samples[0] is
    uint64_t seed;
    double better;                      // share of renders that are partly the truth
    mini_sample* samples;               // of a part of the batch
} mini_batch;

typedef struct tone_curve {
    float saturation, table[BATCH_TABLE + 1]; // of the values from 0 to 1
    int order[3];
} tone_curve;

static double draw_of(const mini_batch* b, size_t sample, int which) {
    return gsf_draw_uniform(b->seed, (uint64_t)b->step * (uint64_t)b->count + sample, (uint64_t)which);
}

static float curved(const tone_curve* t, float x) {
    const float at = x >= 1.0f ? BATCH_TABLE : x > 0.0f ? x * BATCH_TABLE : 0.0f;
    const int i = at >= BATCH_TABLE ? BATCH_TABLE - 1 : (int)at;
    return t->table[i] + (at - (float)i) * (t->table[i + 1] - t->table[i]);
}

static void tone(const tone_curve* t, float* rgb) {
    const float old[3] = {rgb[0], rgb[1], rgb[2]}, grey = (old[0] + old[1] + old[2]) / 3.0f;
    for (int c = 0; c < 3; c++) rgb[c] = curved(t, grey + t->saturation * (old[t->order[c]] - grey));
}

static tone_curve draw_tone(const mini_batch* b, size_t sample) {
    static const int orders[6][3] = {{0, 1, 2}, {0, 2, 1}, {1, 0, 2}, {1, 2, 0}, {2, 0, 1}, {2, 1, 0}};
    tone_curve t;
    const double gamma = exp(0.7 * draw_of(b, sample, 10) - 0.35), gain = exp(0.4 * draw_of(b, sample, 11) - 0.25);
    const int turned = draw_of(b, sample, 13) < 0.1; // a negative
    t.saturation = (float)(0.2 + draw_of(b, sample, 12));
    memcpy(t.order, orders[(int)(6.0 * draw_of(b, sample, 14))], sizeof t.order);
    for (int i = 0; i <= BATCH_TABLE; i++) {
        const double v = gain * pow((double)i / BATCH_TABLE, gamma);
        t.table[i] = (float)(turned ? 1.0 - (v < 1.0 ? v : 1.0) : v < 1.0 ? v : 1.0);
    }
    return t;
}

typedef struct byte_values { float of[2][256]; } byte_values; // data_float of all bytes, without and with a sign

static byte_values list_values(void) {
    byte_values v;
    for (int i = 0; i < 512; i++) v.of[i / 256][i % 256] = data_float((uint8_t)(i % 256), i / 256);
    return v;
}

static void read_pixel(const byte_values* values, const uint8_t* from, mini_sample s, int64_t at, int64_t pixels) {
    for (int k = 0; k < GSF__MINI_FRAME; k++) s.frame[at * GSF__MINI_FRAME + k] = values->of[0][from[k]];
    for (int k = 0; k < 3; k++) s.truth[3 * at + k] = values->of[0][from[GSF__MINI_FRAME + k]];
    for (int r = 0; r < DATA_REFERENCES; r++) {
        const uint8_t* plane = from + DATA_FRAME + r * GSF__MINI_REFERENCE;
        float* to = s.shown + (r * pixels + at) * GSF__MINI_REFERENCE;
        for (int k = 0; k < GSF__MINI_REFERENCE; k++) to[k] = values->of[data_is_signed(k)][plane[k]];
    }
}

// Colours of a pixel in another tone; the residual is the difference between the photo and its render, each in that tone.
static void tone_pixel(const tone_curve* t, mini_sample s, int64_t at, int64_t pixels) {
    tone(t, s.frame + at * GSF__MINI_FRAME);
    tone(t, s.truth + 3 * at);
    for (int r = 0; r < DATA_REFERENCES; r++) {
        float *p = s.shown + (r * pixels + at) * GSF__MINI_REFERENCE, render[3];
        if (p[6] > 0.0f) {
            for (int c = 0; c < 3; c++) render[c] = p[c] - p[3 + c];
            tone(t, p);
            tone(t, render);
            for (int c = 0; c < 3; c++) p[3 + c] = p[c] - render[c];
        }
        if (p[12] > 0.0f) tone(t, p + 9);
    }
}

static void hide_reference(float* p, int carried, int back) {
    if (carried) memset(p, 0, 9 * sizeof *p);
    if (back) memset(p + 9, 0, 5 * sizeof *p);
}

// References that are missing, in whole or by one of the two ways, or exposed differently.
static void vary_references(const mini_batch* b, size_t sample, mini_sample s) {
    const int64_t pixels = b->crop * b->crop;
    for (int r = 0; r < DATA_REFERENCES; r++) {
        const double what = draw_of(b, sample, 20 + 3 * r);
        const int exposed = draw_of(b, sample, 21 + 3 * r) < 0.25;
        const float gain = exposed ? (float)exp(0.16 * draw_of(b, sample, 22 + 3 * r) - 0.08) : 1.0f;
        for (int64_t i = 0; i < pixels; i++) {
            float* p = s.shown + (r * pixels + i) * GSF__MINI_REFERENCE;
            if (what < 0.2) hide_reference(p, what < 0.16, what < 0.12 || what >= 0.16);
            for (int c = 0; c < 3 && exposed; c++) {
                p[c] = gsf__mini_clamp(gain * p[c], 0.0f, 1.0f);
                p[9 + c] = gsf__mini_clamp(gain * p[9 + c], 0.0f, 1.0f);
            }
        }
    }
}

// A hole in the splats: a rectangle of one colour without depth.
static void cut_hole(const mini_batch* b, size_t sample, mini_sample s) {
    const int64_t crop = b->crop, pixels = crop * crop;
    const int64_t w = (int64_t)((double)crop * (0.08 + 0.4 * draw_of(b, sample, 41)));
    const int64_t h = (int64_t)((double)crop * (0.08 + 0.4 * draw_of(b, sample, 42)));
    const int64_t x0 = (int64_t)((double)(crop - w) * draw_of(b, sample, 43));
    const int64_t y0 = (int64_t)((double)(crop - h) * draw_of(b, sample, 44));
    for (int64_t y = y0; y < y0 + h; y++)
        for (int64_t x = x0; x < x0 + w; x++) {
            float* f = s.frame + (y * crop + x) * GSF__MINI_FRAME;
            for (int c = 0; c < 3; c++) f[c] = (float)draw_of(b, sample, 45 + c);
            f[3] = f[4] = 0.0f;
            for (int r = 0; r < DATA_REFERENCES; r++) {
                float* p = s.shown + (r * pixels + y * crop + x) * GSF__MINI_REFERENCE;
                hide_reference(p, 0, 1);
                if (p[6] > 0.0f) p[7] = -1.0f;
            }
        }
}

// Splats with a part of their faults only: less of them in the render, and in the residuals at the photos.
static void better_pixel(float render_part, float residual_part, mini_sample s, int64_t at, int64_t pixels) {
    float* render = s.frame + at * GSF__MINI_FRAME;
    for (int c = 0; c < 3; c++) render[c] = s.truth[3 * at + c] + render_part * (render[c] - s.truth[3 * at + c]);
    for (int r = 0; r < DATA_REFERENCES; r++)
        for (int c = 3; c < 6; c++) s.shown[(r * pixels + at) * GSF__MINI_REFERENCE + c] *= residual_part;
}

// Part of its faults that a render, or the residuals, keep: down to -30 dB.
static float draw_part(const mini_batch* b, size_t sample, int which) {
    return draw_of(b, sample, which) < b->better ? (float)exp(-3.5 * draw_of(b, sample, which + 1)) : 1.0f;
}

static void make_sample(void* arg, size_t index, int32_t worker) {
    const mini_batch* b = (const mini_batch*)arg;
    const mini_sample s = b->samples[index];
    const size_t sample = b->first + index;
    const gsf_nn_tensor* t = b->scenes[(size_t)((double)b->scene_count * draw_of(b, sample, 0))];
    const int64_t height = t->shape[1], width = t->shape[2], crop = b->crop, pixels = crop * crop;
    const int64_t frame = (int64_t)((double)t->shape[0] * draw_of(b, sample, 1));
    const int64_t y0 = (int64_t)((double)(height - crop + 1) * draw_of(b, sample, 2));
    const int64_t x0 = (int64_t)((double)(width - crop + 1) * draw_of(b, sample, 3));
    const int mirror = draw_of(b, sample, 4) < 0.5, flip = draw_of(b, sample, 5) < 0.5, swap = draw_of(b, sample, 6) < 0.5;
    const tone_curve curve = draw_tone(b, sample);
    // Apart from each other, since splats of few photos fit these and are wrong elsewhere: only photos tell what is right.
    const float render_part = draw_part(b, sample, 7), residual_part = draw_part(b, sample, 15);
    const byte_values values = list_values();
    (void)worker;
    for (int64_t y = 0; y < crop; y++)
        for (int64_t x = 0; x < crop; x++) {
            const int64_t at = y * crop + x, v = swap ? x : y, u = swap ? y : x;
            const int64_t row = frame * height + y0 + (flip ? crop - 1 - v : v), column = x0 + (mirror ? crop - 1 - u : u);
            read_pixel(&values, (const uint8_t*)t->data + (row * width + column) * DATA_PIXEL, s, at, pixels);
            tone_pixel(&curve, s, at, pixels);
            better_pixel(render_part, residual_part, s, at, pixels);
        }
    vary_references(b, sample, s);
    if (draw_of(b, sample, 40) < 0.25) cut_hole(b, sample, s);
}

#endif // MINI_BATCHES_H
