// metricnets_viclip.h - overall consistency: ViCLIP's tokenizer, both its transformers, whole clips through gsf_nn_metric.
#ifndef METRICNETS_VICLIP_H
#define METRICNETS_VICLIP_H

#include "metricnets_golden.h"

// A text as its network gets it: padded with zeros behind the id that ends it.
static void viclip_check_ids(gsf_context* ctx, const gsf__viclip* net, const gsf_json* json, const gsf_json_value* entry,
                             const char* text, const test_tensor* ids, size_t index) {
    int32_t* got = (int32_t*)calloc((size_t)net->context, sizeof *got);
    int32_t* words;
    int64_t count = 0;
    size_t all;
    const gsf_json_value* expected = gsf_find_json_member(json, entry, "ids");
    if (CHECK_OK(ctx, gsf__clip_encode(ctx, &net->bpe, text, &words, &all))) {
        CHECK(expected && all == expected->count);
        uint32_t at = expected ? expected->child : 0;
        for (size_t i = 0; i < all && at; i++, at = json->values[at].next) CHECK(words[i] == (int32_t)json->values[at].number);
        gsf_free(ctx, words);
    }
    if (CHECK_OK(ctx, gsf__viclip_tokenize(ctx, net, text, got, &count))) {
        CHECK((int64_t)ids->dim[1] == net->context && count <= net->context);
        for (int64_t i = 0; i < count; i++) CHECK(got[i] == (int32_t)ids->v[index * ids->dim[1] + (size_t)i]);
        CHECK(got[count - 1] == net->bpe.end);
    }
    free(got);
}

typedef struct viclip_seen {
    const test_tensors* io;
    const char* clip; // "a" and so on, or NULL: text
    double bar;       // for clips
    int64_t index;    // of the text
    int compared;
} viclip_seen;

static void viclip_see(void* user, const char* name, int32_t index, const float* data, int64_t rows, int64_t columns) {
    viclip_seen* seen = (viclip_seen*)user;
    char key[96];
    (void)index;
    if (!seen->clip) {
        if (strcmp(name, "text_layer0") != 0 || seen->index >= 4) return;
        test_tensor t = test_get_tensor(seen->io, "text.block0_first4");
        double* whole = t.v;
        t.v += seen->index * (int64_t)(t.dim[1] * t.dim[2]);
        t.count = (size_t)(rows * columns); // those up to the end of the text
        golden_compare("text.block0", data, &t, 1e-6);
        seen->compared++;
        free(whole);
        return;
    }
    const char* what = strcmp(name, "embeddings") == 0 ? "ln_pre"
                       : strcmp(name, "layer0") == 0   ? "block0"
                       : strcmp(name, "feature") == 0  ? "feature"
                                                       : NULL;
    if (!what) return;
    snprintf(key, sizeof key, "%s.%s", seen->clip, what);
    test_tensor t = test_get_tensor(seen->io, key);
    if (CHECK(t.count == (size_t)(rows * columns))) golden_compare(key, data, &t, seen->bar);
    seen->compared++;
    test_free_tensor(&t);
}

// Tokenizer and text transformer on the strings of tokenizer.json. Three of them are only those of `cleaned` after parts of
// ftfy that gsfixer_nn.h names as missing; of the others the raw text is passed.
static void viclip_check_texts(gsf_context* ctx, const gsf__viclip* net, const test_tensors* io) {
    gsf_json json;
    size_t size, index = 0;
    char* text = test_read_file(golden_file("viclip", "tokenizer.json"), &size);
    test_tensor ids = test_get_tensor(io, "text.ids"), features = test_get_tensor(io, "text.features");
    viclip_seen seen = {io, NULL, 0.0, 0, 0};
    const gsf__nn_tap tap = {viclip_see, &seen};
    float* feature = (float*)malloc((size_t)net->features * sizeof(float));
    double* whole = features.v;
    if (CHECK_OK(ctx, gsf_parse_json(ctx, "tokenizer.json", text, size, &json))) {
        const gsf_json_value* strings = gsf_find_json_member(&json, &json.values[0], "strings");
        for (uint32_t i = strings ? strings->child : 0; i; i = json.values[i].next, index++) {
            const gsf_json_value* e = &json.values[i];
            const gsf_json_value* changed = gsf_find_json_member(&json, e, "ftfy_changes_text");
            const int fixed = changed && changed->type == GSF_JSON_TRUE;
            const gsf_json_value* raw = gsf_find_json_member(&json, e, fixed ? "cleaned" : "text");
            if (!CHECK(raw && raw->type == GSF_JSON_STRING)) continue;
            viclip_check_ids(ctx, net, &json, e, raw->string, &ids, index);
            seen.index = (int64_t)index;
            CHECK_OK(ctx, gsf__viclip_encode_text(ctx, net, raw->string, &tap, feature));
            features.v = whole + index * (size_t)net->features;
            features.count = (size_t)net->features;
            golden_compare("text.features", feature, &features, 1e-6);
        }
        CHECK(index == ids.dim[0] && index == features.dim[0] && seen.compared == 4);
        gsf_destroy_json(ctx, &json);
    }
    features.v = whole;
    free(feature);
    free(text);
    test_free_tensor(&ids);
    test_free_tensor(&features);
}

// Frames as bytes: at most a grey level away, where PyTorch's float32 does not see a tie. Then the feature of the golden bytes.
// Returns whether all bytes are the same.
static int viclip_check_frames(gsf_context* ctx, gsf__viclip* net, const test_tensors* io, const char* clip) {
    char key[64];
    snprintf(key, sizeof key, "%s.frames", clip);
    test_tensor frames = test_get_tensor(io, key);
    snprintf(key, sizeof key, "%s.frame_indices", clip);
    test_tensor indices = test_get_tensor(io, key);
    snprintf(key, sizeof key, "%s.resized_u8", clip);
    test_tensor expected = test_get_tensor(io, key);
    snprintf(key, sizeof key, "%s.feature", clip);
    test_tensor wanted = test_get_tensor(io, key);
    const int64_t side = net->grid * net->patch, count = net->samples * 3 * side * side;
    size_t wrong = 0, remote = 0;
    CHECK(indices.count == (size_t)net->samples && expected.count == (size_t)count);
    for (int64_t i = 0; i < net->samples; i++) {
        const int64_t place = gsf__viclip_place(i, net->samples, (int64_t)frames.dim[0]);
        if (!CHECK(place == (int64_t)indices.v[i])) break;
        gsf_image frame = golden_image(&frames, (size_t)place);
        gsf__viclip_resize(&frame, side, net->pixels + i * 3 * side * side);
        free(frame.data);
    }
    for (int64_t i = 0; i < count; i++) {
        const double error = fabs(rint(255.0 * (double)net->pixels[i]) - expected.v[i]);
        wrong += error > 0.0;
        remote += error > 1.0;
        net->pixels[i] = (float)expected.v[i] / 255.0f;
    }
    golden_near("share of other grey levels", (double)wrong / (double)expected.count, 0.0, 5e-4);
    CHECK(remote == 0);
    viclip_seen seen = {io, clip, 1e-6, 0, 0};
    const gsf__nn_tap tap = {viclip_see, &seen};
    CHECK_OK(ctx, gsf__viclip_encode_frames(ctx, net, &tap, net->feature));
    CHECK(seen.compared == 2);
    if (CHECK(wanted.count == (size_t)net->features)) golden_compare(key, net->feature, &wanted, 1e-6);
    test_free_tensor(&frames);
    test_free_tensor(&indices);
    test_free_tensor(&expected);
    test_free_tensor(&wanted);
    return wrong == 0;
}

// The score of a clip and a text; `exact`: all its bytes are those of the reference.
static void viclip_check_clip(gsf_context* ctx, const test_tensors* io, const char* models, const int32_t* heads,
                              const char* clip, int exact, const char* prompt, double score) {
    viclip_seen seen = {io, clip, exact ? 1e-6 : 2e-3, 0, 0};
    const gsf__nn_tap tap = {viclip_see, &seen};
    char key[64];
    gsf_nn_metric metric;
    memset(&metric, 0, sizeof metric);
    metric.kind = GSF_NN_METRIC_OVERALL_CONSISTENCY;
    metric.models = models;
    metric.prompt = prompt;
    metric._heads = heads;
    snprintf(key, sizeof key, "%s.frames", clip);
    test_tensor frames = test_get_tensor(io, key);
    metric.frames = (int64_t)frames.dim[0];
    CHECK_OK(ctx, gsf_nn_measure_frame(ctx, &metric, NULL, NULL));
    metric._tap = &tap;
    for (size_t i = 0; i < frames.dim[0]; i++) {
        gsf_image frame = golden_image(&frames, i);
        CHECK(metric.score == 0.0);
        CHECK_OK(ctx, gsf_nn_measure_frame(ctx, &metric, &frame, NULL));
        if (i + 1 == frames.dim[0])
            CHECK_RESULT(ctx, gsf_nn_measure_frame(ctx, &metric, &frame, NULL), GSF_ERROR_INVALID_ARGUMENT);
        free(frame.data);
    }
    CHECK(seen.compared == 3 && metric.count == metric.frames);
    golden_near(key, metric.score, score, exact ? 2e-6 : 5e-5);
    test_note_error("overall_consistency", fabs(metric.score - score));
    gsf_nn_destroy_metric(ctx, &metric);
    test_free_tensor(&frames);
}

// What is refused, and memory that runs out.
static void viclip_check_errors(gsf_context* ctx, const test_tensors* io, const char* models, const int32_t* heads) {
    test_tensor frames = test_get_tensor(io, "a.frames");
    gsf_image frame = golden_image(&frames, 0);
    gsf_nn_metric metric;
    memset(&metric, 0, sizeof metric);
    metric.kind = GSF_NN_METRIC_OVERALL_CONSISTENCY;
    metric.models = models;
    metric._heads = heads;
    CHECK_RESULT(ctx, gsf_nn_measure_frame(ctx, &metric, &frame, NULL), GSF_ERROR_INVALID_ARGUMENT);
    metric.prompt = "not \xff UTF-8";
    CHECK_RESULT(ctx, gsf_nn_measure_frame(ctx, &metric, &frame, NULL), GSF_ERROR_INVALID_ARGUMENT);
    metric.prompt = "a text";
    CHECK_RESULT(ctx, gsf_nn_measure_frame(ctx, &metric, &frame, NULL), GSF_ERROR_INVALID_ARGUMENT); // of how many frames?
    gsf_nn_destroy_metric(ctx, &metric);
    gsf_result result = GSF_ERROR_OUT_OF_MEMORY;
    size_t k = 1;
    for (; result != GSF_OK && k < 2000; k += 3) {
        gsf_context other;
        counter c;
        memset(&c, 0, sizeof c);
        memset(&metric, 0, sizeof metric);
        test_context_zero(&other);
        count_memory(&other, &c);
        CHECK_OK(&other, gsf_init_context(&other));
        metric.kind = GSF_NN_METRIC_OVERALL_CONSISTENCY;
        metric.models = models;
        metric._heads = heads;
        metric.prompt = "&quot;A text&quot; &amp;amp; more";
        metric.frames = 1;
        c.fail_at = k;
        result = gsf_nn_measure_frame(&other, &metric, &frame, NULL);
        CHECK_RESULT(&other, result, c.calls < k ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY);
        gsf_nn_destroy_metric(&other, &metric);
        CHECK(c.live == 0);
    }
    CHECK(k > 20 && result == GSF_OK);
    free(frame.data);
    test_free_tensor(&frames);
}

// Texts whose cleaning goes through tables.
static void viclip_check_cleaning(gsf_context* ctx, const gsf__clip_bpe* bpe) {
    static const char* const texts[][2] = {
        {"A &LT; b &amp;amp;lt; c", "a &lt; b < c"},
        {"x &ampy &notit; &#x41;&#66 &#0; &#133;", "x &y &notit; ab \xef\xbf\xbd \xe2\x80\xa6"},
        {"\xe2\x80\x9c\xc3\x89t\xc3\xa9\xe2\x80\x9d \xef\xac\x81n \xef\xbc\xa1\xe3\x80\x80z", "\"\xc3\xa9t\xc3\xa9\" fin a z"},
        {"\xce\x9f\xce\x94\xce\x9f\xce\xa3 \xce\xa3\xc3\x9f\xc4\xb0\xf0\x90\x90\x80",
         "\xce\xbf\xce\xb4\xce\xbf\xcf\x82 \xcf\x83\xc3\x9fi\xcc\x87\xf0\x90\x90\xa8"},
        {"a\x01\x7f" "b\xef\xbb\xbf\xc2\x92s < &ldquo;", "ab's < \xe2\x80\x9c"}, {"&ldquo;q&rdquo; &", "\"q\" &"}, {"", ""}};
    for (size_t i = 0; i < sizeof texts / sizeof *texts; i++) {
        gsf_buffer clean;
        if (!CHECK_OK(ctx, gsf__clip_clean(ctx, bpe, texts[i][0], &clean))) continue;
        if (!CHECK(clean.size == strlen(texts[i][1]) && memcmp(clean.data ? clean.data : "", texts[i][1], clean.size) == 0))
            fprintf(stderr, "    %s: %.*s\n", texts[i][0], (int)clean.size, clean.data ? clean.data : "");
        gsf_destroy_buffer(ctx, &clean);
    }
}

static void viclip_check_merges(gsf_context* ctx) { // lists of merges that are refused, and one that is not compressed
    static const struct { const char* text; gsf_result result; } lists[] = {
        {"comment\na b\nab c</w>\n", GSF_OK}, {"", GSF_OK}, {"comment\na b c\n", GSF_ERROR_FORMAT},
        {"comment\na b\n\nc d\n", GSF_ERROR_FORMAT}, {"comment\nab c\n", GSF_ERROR_FORMAT},
        {"\x1f\x8bnot gzip", GSF_ERROR_FORMAT}};
    char folder[1024], path[1200];
    golden_make_models(ctx, "viclip_merges", folder);
    snprintf(path, sizeof path, "%s/bpe_simple_vocab_16e6.txt", folder);
    for (size_t i = 0; i < sizeof lists / sizeof *lists; i++) {
        gsf__clip_bpe bpe;
        memset(&bpe, 0, sizeof bpe);
        CHECK_OK(ctx, gsf_write_file(ctx, path, lists[i].text, strlen(lists[i].text)));
        CHECK_RESULT(ctx, gsf__clip_open(ctx, folder, &bpe), lists[i].result);
        if (i == 0) {
            int32_t* ids = NULL;
            size_t count = 0;
            CHECK(bpe.begin == 514 && bpe.end == 515);
            CHECK_OK(ctx, gsf__clip_encode(ctx, &bpe, "abc ab", &ids, &count));
            CHECK(count == 3 && ids[0] == 513 && ids[1] == 'a' - '!' && ids[2] == 256 + 'b' - '!');
            gsf_free(ctx, ids);
        }
        gsf__clip_close(ctx, &bpe);
    }
}

static void viclip_check_places(gsf_context* ctx) { // frame_indices_middle8 of the metrics' golden files
    size_t size;
    char* text = test_read_file(test_golden("metrics/vbench_expected.json"), &size);
    gsf_json json;
    if (CHECK_OK(ctx, gsf_parse_json(ctx, "vbench_expected.json", text, size, &json))) {
        const gsf_json_value* lists = gsf_find_json_member(&json, &json.values[0], "frame_indices_middle8");
        CHECK(lists && lists->count > 0);
        for (uint32_t i = lists ? lists->child : 0; i; i = json.values[i].next) {
            int64_t index = 0;
            for (uint32_t k = json.values[i].child; k; k = json.values[k].next, index++)
                CHECK(gsf__viclip_place(index, 8, (int64_t)atoi(json.values[i].key)) == (int64_t)json.values[k].number);
            CHECK(index == 8);
        }
        gsf_destroy_json(ctx, &json);
    }
    free(text);
}

static void viclip_check_resize(void) { // pre.NAME.viclip_resize24_bicubic_noaa_crop of the metrics' golden files
    static const char* const names[2] = {"tall", "wide"};
    test_tensors file = test_open_tensors(test_golden("metrics/vbench.safetensors"));
    for (int i = 0; i < 2; i++) {
        char key[96];
        snprintf(key, sizeof key, "pre.%s.input", names[i]);
        test_tensor in = test_get_tensor(&file, key);
        snprintf(key, sizeof key, "pre.%s.viclip_resize24_bicubic_noaa_crop", names[i]);
        test_tensor expected = test_get_tensor(&file, key);
        const size_t area = in.dim[1] * in.dim[2];
        uint8_t* bytes = (uint8_t*)malloc(in.count);
        float* pixels = (float*)malloc(expected.count * sizeof(float));
        for (size_t k = 0; k < in.count; k++) bytes[k % area * 3 + k / area] = (uint8_t)in.v[k];
        const gsf_image image = gsf_wrap_image(bytes, GSF_U8, (int64_t)in.dim[2], (int64_t)in.dim[1], 3);
        gsf__viclip_resize(&image, (int64_t)expected.dim[1], pixels);
        for (size_t k = 0; k < expected.count; k++) CHECK(fabs(255.0 * (double)pixels[k] - expected.v[k]) < 1.01);
        free(bytes);
        free(pixels);
        test_free_tensor(&in);
        test_free_tensor(&expected);
    }
    test_close_tensors(&file);
}

static inline void check_viclip(void) {
    gsf_context ctx;
    golden_config config;
    gsf__viclip net;
    gsf_nn_metric metric;
    char models[1024];
    test_context_init(&ctx);
    if (!golden_open_config(&ctx, "viclip", &config)) return;
    const int32_t heads[2] = {(int32_t)golden_number(&config, "vision_heads", NULL, NULL, -1),
                              (int32_t)golden_number(&config, "text_heads", NULL, NULL, -1)};
    golden_make_models(&ctx, "viclip_models", models);
    golden_copy(&ctx, "viclip", "weights.safetensors", models, "ViClip-InternVid-10M-FLT.safetensors");
    golden_copy(&ctx, "viclip", "bpe_tiny_vocab.txt.gz", models, "bpe_simple_vocab_16e6.txt.gz");
    test_tensors io = test_open_tensors(golden_file("viclip", "io.safetensors"));
    memset(&net, 0, sizeof net);
    memset(&metric, 0, sizeof metric);
    metric.models = models;
    metric.prompt = "";
    metric._heads = heads;
    if (CHECK_OK(&ctx, gsf__viclip_open(&ctx, &metric, &net))) {
        const gsf_json_value* list = gsf_find_json_member(&config.json, &config.json.values[0], "overall_consistency");
        gsf_json json;
        size_t size;
        char* text = test_read_file(golden_file("viclip", "tokenizer.json"), &size);
        viclip_check_texts(&ctx, &net, &io);
        viclip_check_cleaning(&ctx, &net.bpe);
        const int exact[2] = {viclip_check_frames(&ctx, &net, &io, "a"), viclip_check_frames(&ctx, &net, &io, "short")};
        CHECK_OK(&ctx, gsf_parse_json(&ctx, "tokenizer.json", text, size, &json));
        const gsf_json_value* strings = gsf_find_json_member(&json, &json.values[0], "strings");
        CHECK(list && list->count > 0);
        for (uint32_t i = list ? list->child : 0; i; i = config.json.values[i].next) {
            const gsf_json_value* e = &config.json.values[i];
            const gsf_json_value* index = gsf_find_json_member(&config.json, e, "text_index");
            const gsf_json_value* string = gsf_find_json_element(&json, strings, (uint32_t)index->number);
            const char* clip = gsf_find_json_member(&config.json, e, "video")->string;
            viclip_check_clip(&ctx, &io, models, heads, clip, exact[strcmp(clip, "a") != 0],
                              gsf_find_json_member(&json, string, "text")->string,
                              gsf_find_json_member(&config.json, e, "score")->number);
        }
        gsf_destroy_json(&ctx, &json);
        free(text);
    }
    gsf__viclip_close(&ctx, &net);
    viclip_check_errors(&ctx, &io, models, heads);
    viclip_check_merges(&ctx);
    viclip_check_places(&ctx);
    viclip_check_resize();
    test_close_tensors(&io);
    golden_close_config(&ctx, &config);
}

#endif
