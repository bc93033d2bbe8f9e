/* train_restorer - trains the paper's model, or low-rank adapters (LoRA) for it, on sequences that gsfix dataset made
   gcc -O2 -std=c11 -fopenmp -I. examples/train_restorer.c -o train_restorer -lm

       train_restorer OUT --model MODEL_DIR --data DATASET [--lora RANK [--alpha RANK] [--targets to_q,to_k,to_v,to_out.0]]
           [--iterations 10000] [--batch 8] [--groups 8] [--rate 2e-5] [--warmup 500] [--cosine] [--weight-decay 0.01]
           [--clip 1] [--average 0] [--drop-references 0.1] [--drop-prompt 0.1] [--seed 0] [--save-every 100] [--cache DIR]
           [--caption TEXT] [--threads N] [--bf16] [--resume] [--memory]

   MODEL_DIR: as for gsfix fix --restorer dit:MODEL_DIR; DATASET: the DIR of gsfix dataset. Each sequence is encoded once, by
   the code that encodes clips for the restorer, to a file in OUT/cache: frames and photos (VAE), references (DINOv2, VGGT),
   prompt (T5; the caption is that of the data set or --caption, else BLIP-2's). Sequences are resampled to the model's
   length.

   The loss is the mean squared error of the velocity at a random time step. The paper states the learning rate, AdamW, the
   iterations, the batch and that there is a warm-up; the other defaults are this program's. --drop-references,
   --drop-prompt: probability that an example has no references, or the negative prompt. --average: decay of a moving average
   of the weights, which is then what is saved.

   OUT gets transformer/ in the released layout, and links to the other parts of MODEL_DIR: use it as dit:OUT. With --lora it
   gets adapter_model.safetensors and adapter_config.json as peft writes them: dit:MODEL_DIR --lora OUT. OUT/training.state
   is what --resume continues from, written every --save-every steps; a run that was killed and resumed ends with the same
   bytes, as do runs with other numbers of threads. Delete OUT/cache if the weights of MODEL_DIR's encoders change.
   OUT/training.loss.html shows the loss.
   --bf16: products of bfloat16, where the processor has them fast (AMX; AVX-512 of AMD since Zen 4): operands are rounded to
   bfloat16, sums, weights, gradients and everything else stay float32. On all processors the blocks' inputs, which are kept for
   the way back, are rounded to it, too, and take half the memory.
   --memory: only print what training needs. With -DGSF_USE_MPI, compiled by mpicc, up to --groups ranks share each batch:
       mpirun -np 2 train_restorer ...
   writes the bytes of one rank (training.h). OUT is then on storage that all of them see. */
#ifndef _XOPEN_SOURCE
#define _XOPEN_SOURCE 700
#endif
#define GSF_NN_TRAINING
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "training.h"

#include <errno.h>
#include <sys/stat.h>
#if defined(_WIN32)
#include <direct.h>
#define make_folder(path) _mkdir(path)
#else
#include <unistd.h>
#define make_folder(path) mkdir(path, 0777)
#endif

typedef struct options {
    const char *out, *model, *data, *cache, *caption, *targets;
    int lora, iterations, batch, groups, warmup, cosine, save_every, threads, bf16, resume, memory;
    double rate, alpha, decay, clip, average, drop_references, drop_prompt;
    uint64_t seed;
} options;

typedef struct path { char text[TRAINING_PATH]; } path;

typedef struct example { // the memory of one
    float *latents, *noise, *control, *text, *dino, *vggt;
} example;

typedef struct training {
    gsf_context ctx;
    options o;
    training_ranks ranks;
    path* sequences;              // manifests of the data set's
    size_t sequence_count, sequence_room;
    gsf_nn_weights* cached;       // a file of each sequence
    gsf_nn_transformer net;
    gsf_nn_schedule schedule;
    gsf__lora lora;
    gsf__nn_params params;
    training_sum sum;
    training_log log;
    int32_t frames, height, width; // of the latents
    size_t count;                  // values of an example's latents
    example* examples;             // of a group
    gsf__dit_example* inputs;
    float* memory;                 // of all of them
    size_t* order;                 // of the sequences in this epoch
    int64_t epoch;
} training;

static path join(const char* folder, const char* name) {
    path p;
    const int n = snprintf(p.text, sizeof p.text, "%s/%s", folder, name);
    if (n < 0 || (size_t)n >= sizeof p.text) p.text[0] = 0; // no such file
    return p;
}

static int is_there(const char* name) {
    struct stat s;
    return stat(name, &s) == 0;
}

static gsf_result need_folder(gsf_context* ctx, const char* name) {
    if (make_folder(name) == 0 || errno == EEXIST) return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_IO, "%s: %s", name, strerror(errno));
}

// ---- the data set ------------------------------------------------------------------

static gsf_result load_json(gsf_context* ctx, const char* name, gsf_json* json) {
    void* text;
    size_t size;
    memset(json, 0, sizeof *json);
    gsf_result result = gsf_read_file(ctx, name, &text, &size);
    if (result != GSF_OK) return result;
    result = gsf_parse_json(ctx, name, (const char*)text, size, json);
    gsf_free(ctx, text);
    return result;
}

// A file's name in an object; NULL if there is none, or if it leads out of the scene's folder.
static const char* inner_name(const gsf_json* json, const gsf_json_value* object, const char* key) {
    const gsf_json_value* v = gsf_find_json_member(json, object, key);
    if (!v || v->type != GSF_JSON_STRING || !v->string_size || strlen(v->string) != v->string_size) return NULL;
    if (v->string[0] == '/' || strstr(v->string, "..") || strchr(v->string, '\\') || strchr(v->string, ':')) return NULL;
    return v->string;
}

static gsf_result add_sequence(training* t, const char* folder, const char* name) {
    if (t->sequence_count == t->sequence_room) {
        const size_t room = t->sequence_room ? 2 * t->sequence_room : 64;
        path* more = (path*)gsf_alloc(&t->ctx, room, sizeof *more);
        if (!more) return GSF_ERROR_OUT_OF_MEMORY;
        if (t->sequence_count) memcpy(more, t->sequences, t->sequence_count * sizeof *more);
        gsf_free(&t->ctx, t->sequences);
        t->sequences = more;
        t->sequence_room = room;
    }
    t->sequences[t->sequence_count++] = join(folder, name);
    return GSF_OK;
}

static gsf_result list_scene(training* t, const char* scene) {
    gsf_json json;
    const path folder = join(t->o.data, scene), manifest = join(folder.text, "manifest.json");
    gsf_result result = load_json(&t->ctx, manifest.text, &json);
    if (result != GSF_OK) return result;
    const gsf_json_value* list = gsf_find_json_member(&json, json.values, "sequences");
    for (uint32_t i = list ? list->child : 0; i && result == GSF_OK; i = json.values[i].next) {
        const char* name = inner_name(&json, &json.values[i], "file");
        result = name ? add_sequence(t, folder.text, name)
                      : gsf_fail(&t->ctx, GSF_ERROR_FORMAT, "%s: a sequence without a file", manifest.text);
    }
    gsf_destroy_json(&t->ctx, &json);
    return result;
}

static gsf_result list_data(training* t) {
    void* text;
    size_t size;
    char scene[512];
    gsf_result result = gsf_read_file(&t->ctx, join(t->o.data, "scenes.txt").text, &text, &size);
    if (result != GSF_OK) return result;
    for (size_t at = 0, n = 0; at < size && result == GSF_OK; at++) {
        const char c = ((const char*)text)[at];
        if (c != '\n' && c != '\r' && n + 1 < sizeof scene) scene[n++] = c;
        if (c != '\n' && at + 1 < size) continue;
        scene[n] = 0;
        if (n) result = list_scene(t, scene);
        n = 0;
    }
    gsf_free(&t->ctx, text);
    if (result == GSF_OK && !t->sequence_count)
        result = gsf_fail(&t->ctx, GSF_ERROR_FORMAT, "%s: no sequences", t->o.data);
    return result;
}

// ---- encoding ----------------------------------------------------------------------

typedef struct clip { // a sequence at the model's size and length
    gsf_image *artifact, *clean; // f32
    gsf_image photos[2];         // u8, of the first and last frame, at their own size
    int32_t* reference;          // per frame: the photo at its view, or -1
    char caption[1024];
} clip;

static void free_clip(gsf_context* ctx, clip* c, int32_t frames) {
    for (int32_t i = 0; i < frames; i++) {
        if (c->artifact) gsf_destroy_image(ctx, &c->artifact[i]);
        if (c->clean) gsf_destroy_image(ctx, &c->clean[i]);
    }
    for (int i = 0; i < 2; i++) gsf_destroy_image(ctx, &c->photos[i]);
    gsf_free(ctx, c->artifact);
    gsf_free(ctx, c->clean);
    gsf_free(ctx, c->reference);
}

// photo (or NULL) receives the image at its own size.
static gsf_result load_frame(gsf_context* ctx, const char* name, int64_t width, int64_t height, gsf_image* photo,
                             gsf_image* out) {
    gsf_image whole, small;
    memset(&small, 0, sizeof small);
    gsf_result result = gsf_load_image(ctx, name, 3, &whole);
    if (result == GSF_OK && whole.dtype != GSF_U8) result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: not 8 bits deep", name);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_U8, width, height, 3, &small);
    if (result == GSF_OK) result = gsf_resize_image(ctx, &whole, GSF_RESIZE_PIL_BICUBIC, &small);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, width, height, 3, out);
    if (result == GSF_OK) result = gsf_convert_image(ctx, &small, out);
    gsf_destroy_image(ctx, &small);
    if (result == GSF_OK && photo) *photo = whole;
    else gsf_destroy_image(ctx, &whole);
    return result;
}

static gsf_result load_clip(gsf_context* ctx, const gsf__dit_restorer* r, const char* manifest, clip* c) {
    const int32_t frames = r->transformer.sample_frames;
    const int64_t width = r->transformer.sample_width * r->vae.spatial_ratio;
    const int64_t height = r->transformer.sample_height * r->vae.spatial_ratio;
    gsf_json json;
    path folder;
    memset(c, 0, sizeof *c);
    gsf_result result = load_json(ctx, manifest, &json);
    if (result != GSF_OK) return result;
    const gsf_json_value *list = gsf_find_json_member(&json, json.values, "frames");
    const gsf_json_value* caption = gsf_find_json_member(&json, json.values, "caption");
    if (!list || list->type != GSF_JSON_ARRAY || list->count < 2 || frames < 2)
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: not a sequence of frames", manifest);
    if (caption && caption->type == GSF_JSON_STRING) snprintf(c->caption, sizeof c->caption, "%s", caption->string);
    snprintf(folder.text, sizeof folder.text, "%s", manifest); // SCENE/sequences/NAME.json: names are relative to SCENE
    for (int i = 0; i < 2; i++)
        if (strrchr(folder.text, '/')) *strrchr(folder.text, '/') = 0;
    c->artifact = (gsf_image*)gsf_alloc_zeroed(ctx, (size_t)frames, sizeof *c->artifact);
    c->clean = (gsf_image*)gsf_alloc_zeroed(ctx, (size_t)frames, sizeof *c->clean);
    c->reference = (int32_t*)gsf_alloc(ctx, (size_t)frames, sizeof *c->reference);
    if (result == GSF_OK && (!c->artifact || !c->clean || !c->reference)) result = GSF_ERROR_OUT_OF_MEMORY;
    for (int32_t i = 0; i < frames && result == GSF_OK; i++) {
        const size_t at = ((size_t)i * (list->count - 1) + (size_t)(frames - 1) / 2) / (size_t)(frames - 1);
        const gsf_json_value* frame = gsf_find_json_element(&json, list, at);
        const char *artifact = inner_name(&json, frame, "artifact"), *clean = inner_name(&json, frame, "clean");
        if (!artifact || !clean) {
            result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: frame %zu lacks a file", manifest, at);
            break;
        }
        c->reference[i] = at == 0 ? 0 : at + 1 == list->count ? 1 : -1;
        gsf_image* photo = i == 0 ? &c->photos[0] : i == frames - 1 ? &c->photos[1] : NULL;
        result = load_frame(ctx, join(folder.text, artifact).text, width, height, NULL, &c->artifact[i]);
        if (result == GSF_OK)
            result = load_frame(ctx, join(folder.text, clean).text, width, height, photo, &c->clean[i]);
    }
    gsf_destroy_json(ctx, &json);
    return result;
}

typedef struct encoded { // one after another in `memory`
    float* memory;
    float *video, *mean, *spread, *latents, *deviation, *control;
    const float* text;
    gsf_nn_features features;
    size_t count;
} encoded;

static gsf_result encode_video(gsf_context* ctx, gsf__dit_restorer* r, const gsf_restore_window* window, float* spread,
                               const encoded* e) {
    gsf_result result = gsf__dit_fill_control(ctx, r, window, e->video);
    if (result != GSF_OK) return result;
    return gsf_nn_encode_vae(ctx, &r->vae, NULL, e->video, window->frame_count, window->color[0].height,
                             window->color[0].width, e->mean, spread);
}

static gsf_result encode_references(gsf_context* ctx, gsf__dit_restorer* r, const gsf_restore_window* window,
                                    gsf_nn_features* out) {
    gsf__dit_clip c;
    int32_t chosen[4];
    memset(&c, 0, sizeof c);
    c.ctx = ctx;
    c.r = r;
    c.chosen = chosen;
    c.count = gsf__dit_choose(r, window, chosen);
    gsf_result result = gsf__dit_gather(&c, GSF__DIT_DINO, &c.features.dino, &c.features.dino_channels);
    if (result == GSF_OK) result = gsf__dit_gather(&c, GSF__DIT_VGGT, &c.features.vggt, &c.features.vggt_channels);
    gsf_destroy_buffer(ctx, &c.name);
    *out = c.features;
    return result;
}

static gsf_result save_encoded(gsf_context* ctx, const gsf__dit_restorer* r, const encoded* e, int32_t frames, const char* to) {
    const gsf_nn_transformer* n = &r->transformer;
    const int64_t latents[4] = {frames, n->out_channels, n->sample_height, n->sample_width};
    const int64_t text[3] = {2, n->text_tokens, n->text_channels}, tokens = e->features.images * e->features.tokens;
    const int64_t dino[2] = {tokens, n->dino_channels}, vggt[2] = {tokens, n->vggt_channels};
    const gsf_nn_tensor all[6] = {gsf_nn_wrap_tensor("control", e->control, 4, latents),
                                  gsf_nn_wrap_tensor("deviation", e->deviation, 4, latents),
                                  gsf_nn_wrap_tensor("dino", e->features.dino, 2, dino),
                                  gsf_nn_wrap_tensor("latents", e->latents, 4, latents),
                                  gsf_nn_wrap_tensor("text", e->text, 3, text),
                                  gsf_nn_wrap_tensor("vggt", e->features.vggt, 2, vggt)};
    return gsf_nn_save_tensors(ctx, to, all, 6);
}

// Artifact frames become the control, with photos at the references, exactly as when the restorer runs.
static gsf_result encode_clip(gsf_context* ctx, gsf_restorer* restorer, const clip* c, const char* caption, const char* to) {
    gsf__dit_restorer* r = (gsf__dit_restorer*)restorer->user;
    const gsf_nn_transformer* n = &r->transformer;
    const int32_t frames = (n->sample_frames - 1) / n->temporal_ratio + 1;
    const int64_t plane = (int64_t)n->sample_height * n->sample_width, ratio = r->vae.spatial_ratio;
    const size_t pixels = (size_t)(3 * n->sample_frames * plane * ratio * ratio);
    gsf_reference photos[2];
    gsf_restore_window window;
    encoded e;
    memset(&e, 0, sizeof e);
    memset(photos, 0, sizeof photos);
    memset(&window, 0, sizeof window);
    window.struct_size = sizeof window;
    window.frame_count = n->sample_frames;
    window.color = c->artifact;
    window.reference_index = c->reference;
    window.caption = caption ? caption : c->caption[0] ? c->caption : NULL;
    for (int i = 0; i < 2; i++) photos[i].color = c->photos[i];
    e.count = (size_t)(frames * n->out_channels * plane);
    e.memory = (float*)gsf_alloc(ctx, pixels + 5 * e.count, sizeof(float));
    if (!e.memory) return GSF_ERROR_OUT_OF_MEMORY;
    e.video = e.memory;
    float** const parts[] = {&e.mean, &e.spread, &e.latents, &e.deviation, &e.control};
    for (size_t i = 0; i < 5; i++) *parts[i] = e.video + pixels + i * e.count;
    gsf_result result = restorer->begin_fn(r, ctx, photos, 2);
    const int begun = result == GSF_OK;
    const float scale = (float)r->vae.scaling_factor;
    if (result == GSF_OK) result = encode_video(ctx, r, &window, NULL, &e);
    if (result == GSF_OK) gsf__swap_frames(e.mean, n->out_channels, frames, plane, scale, e.control);
    window.color = c->clean;
    if (result == GSF_OK) result = encode_video(ctx, r, &window, e.spread, &e);
    if (result == GSF_OK) {
        for (size_t i = 0; i < e.count; i++) e.spread[i] = (float)exp(0.5 * (double)e.spread[i]);
        gsf__swap_frames(e.mean, n->out_channels, frames, plane, scale, e.latents);
        gsf__swap_frames(e.spread, n->out_channels, frames, plane, scale, e.deviation);
        result = encode_references(ctx, r, &window, &e.features);
    }
    if (result == GSF_OK) result = gsf__dit_prompt(ctx, r, &window, &e.text);
    if (result == GSF_OK) result = save_encoded(ctx, r, &e, frames, to);
    if (begun) restorer->end_fn(r, ctx);
    gsf_nn_destroy_features(ctx, &e.features);
    gsf_free(ctx, e.memory);
    return result;
}

// A name for what a sequence is encoded to: a checksum of its manifest, which has those of all files, and of the caption.
static gsf_result cache_name(training* t, size_t i, path* out) {
    void* text;
    size_t size;
    char name[64];
    gsf_result result = gsf_read_file(&t->ctx, t->sequences[i].text, &text, &size);
    if (result != GSF_OK) return result;
    uint32_t sum = gsf__crc32(0, text, size);
    if (t->o.caption) sum = gsf__crc32(sum, t->o.caption, strlen(t->o.caption));
    snprintf(name, sizeof name, "%06zu-%08x.safetensors", i, (unsigned)sum);
    gsf_free(&t->ctx, text);
    *out = join(t->o.cache, name);
    return GSF_OK;
}

static gsf_result encode_data(training* t) {
    gsf_context* ctx = &t->ctx;
    gsf_restorer restorer;
    gsf_nn_dit_desc desc;
    memset(&restorer, 0, sizeof restorer);
    memset(&desc, 0, sizeof desc);
    desc.model = t->o.model;
    desc.caption = t->o.caption;
    gsf_result result = need_folder(ctx, t->o.cache);
    for (size_t i = 0; i < t->sequence_count && result == GSF_OK; i++) {
        path to;
        clip c;
        result = cache_name(t, i, &to);
        if (result != GSF_OK || is_there(to.text)) continue;
        if (!restorer.user) result = gsf_nn_make_dit(ctx, &desc, &restorer);
        if (result != GSF_OK) break;
        const gsf__dit_restorer* r = (const gsf__dit_restorer*)restorer.user;
        result = load_clip(ctx, r, t->sequences[i].text, &c);
        if (result == GSF_OK) result = encode_clip(ctx, &restorer, &c, t->o.caption, to.text);
        free_clip(ctx, &c, r->transformer.sample_frames);
        fprintf(stderr, "encoded %zu of %zu sequences, %.1f CPU minutes\n", i + 1, t->sequence_count, training_cpu_minutes());
    }
    gsf_destroy_restorer(ctx, &restorer);
    return result;
}

// ---- adapters ----------------------------------------------------------------------

static int is_target(const char* module, const char* targets) { // a module's name, or the end of it after a period
    const size_t size = strlen(module);
    for (const char* p = targets; *p; p += strcspn(p, ","), p += *p == ',') {
        const size_t n = strcspn(p, ",");
        if (n && n <= size && strncmp(module + size - n, p, n) == 0 && (n == size || module[size - n - 1] == '.')) return 1;
    }
    return 0;
}

static gsf_result save_adapter_config(training* t) {
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    gsf_append_text(&t->ctx, &text,
                    "{\n  \"alpha_pattern\": {},\n  \"auto_mapping\": null,\n  \"base_model_name_or_path\": null,\n"
                    "  \"bias\": \"none\",\n  \"fan_in_fan_out\": false,\n  \"inference_mode\": true,\n"
                    "  \"init_lora_weights\": true,\n  \"lora_alpha\": %.17g,\n  \"lora_dropout\": 0.0,\n"
                    "  \"modules_to_save\": null,\n  \"peft_type\": \"LORA\",\n  \"r\": %d,\n  \"rank_pattern\": {},\n"
                    "  \"target_modules\": [",
                    t->o.alpha, t->o.lora);
    for (const char* p = t->o.targets; *p; p += strcspn(p, ","), p += *p == ',')
        gsf_append_text(&t->ctx, &text, "%s\"%.*s\"", p == t->o.targets ? "" : ", ", (int)strcspn(p, ","), p);
    gsf_append_text(&t->ctx, &text, "],\n  \"task_type\": null,\n  \"use_dora\": false,\n  \"use_rslora\": false\n}\n");
    const gsf_result result = text.failed ? GSF_ERROR_OUT_OF_MEMORY
                                          : gsf_write_file(&t->ctx, join(t->o.out, "adapter_config.json").text, text.data,
                                                           text.size);
    gsf_destroy_buffer(&t->ctx, &text);
    return result;
}

// Writes new adapters, which change nothing yet: a random as peft draws it (uniform, 1 / sqrt(in) at most), b zero.
static gsf_result make_adapters(training* t) {
    const gsf_nn_weights* w = &t->net.weights;
    gsf_nn_tensor* all = (gsf_nn_tensor*)gsf_alloc(&t->ctx, 2 * w->tensor_count, sizeof *all);
    path* names = (path*)gsf_alloc(&t->ctx, 2 * w->tensor_count, sizeof *names);
    size_t count = 0, values = 0, used = 0;
    gsf_result result = all && names ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < w->tensor_count && result == GSF_OK; i++) {
        const gsf_nn_tensor* x = &w->tensors[i];
        const int module = (int)strlen(x->name) - 7;
        path name;
        if (x->rank != 2 || module < 1 || strcmp(x->name + module, ".weight") != 0) continue;
        snprintf(name.text, sizeof name.text, "%.*s", module, x->name);
        if (!is_target(name.text, t->o.targets)) continue;
        for (int half = 0; half < 2; half++) {
            const int64_t shape[2] = {half ? x->shape[0] : t->o.lora, half ? t->o.lora : x->shape[1]};
            snprintf(names[count].text, sizeof names[count].text, "base_model.model.%.*s.lora_%c.weight", module, x->name,
                     half ? 'B' : 'A');
            all[count] = gsf_nn_wrap_tensor(names[count].text, NULL, 2, shape);
            values += (size_t)all[count++].count;
        }
    }
    if (result == GSF_OK && !count)
        result = gsf_fail(&t->ctx, GSF_ERROR_INVALID_ARGUMENT, "no linear layer of the model is named %s", t->o.targets);
    float* memory = result == GSF_OK ? (float*)gsf_alloc_zeroed(&t->ctx, values, sizeof(float)) : NULL;
    if (result == GSF_OK && !memory) result = GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < count && result == GSF_OK; i++) {
        float* to = memory + used;
        const double most = 1.0 / sqrt((double)all[i].shape[1]);
        for (int64_t k = 0; k < all[i].count && i % 2 == 0; k++)
            to[k] = (float)(most * (2.0 * gsf_draw_uniform(t->o.seed, i, (uint64_t)k) - 1.0));
        all[i].data = to;
        used += (size_t)all[i].count;
    }
    if (result == GSF_OK)
        result = gsf_nn_save_tensors(&t->ctx, join(t->o.out, "adapter_model.safetensors").text, all, count);
    if (result == GSF_OK) result = save_adapter_config(t);
    gsf_free(&t->ctx, memory);
    gsf_free(&t->ctx, names);
    gsf_free(&t->ctx, all);
    return result;
}

// ---- files -------------------------------------------------------------------------

// What the bytes of a run depend on, besides the data and the model; compared when it goes on.
static gsf_result meet_settings(training* t) {
    const options* o = &t->o;
    const path name = join(o->out, "training.json");
    gsf_buffer text;
    void* old = NULL;
    size_t size = 0;
    memset(&text, 0, sizeof text);
    gsf_append_text(&t->ctx, &text, "{\"format\": \"gsfixer training 1\", \"sequences\": %zu, \"lora\": %d, \"alpha\": %.17g, ",
                    t->sequence_count, o->lora, o->alpha);
    gsf_append_text(&t->ctx, &text, "\"targets\": \"%s\", \"batch\": %d, \"groups\": %d, \"rate\": %.17g, \"warmup\": %d, ",
                    o->lora ? o->targets : "", o->batch, o->groups, o->rate, o->warmup);
    gsf_append_text(&t->ctx, &text, "\"cosine\": %d, \"weight_decay\": %.17g, \"clip\": %.17g, \"average\": %.17g, ",
                    o->cosine ? o->iterations : 0, o->decay, o->clip, o->average);
    gsf_append_text(&t->ctx, &text, "\"drop_references\": %.17g, \"drop_prompt\": %.17g, \"seed\": \"%llu\"%s}\n",
                    o->drop_references, o->drop_prompt, (unsigned long long)o->seed, o->bf16 ? ", \"bf16\": 1" : "");
    gsf_result result = text.failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
    const int has_state = is_there(join(o->out, "training.state").text);
    if (result == GSF_OK && has_state && !o->resume)
        result = gsf_fail(&t->ctx, GSF_ERROR_INVALID_ARGUMENT, "%s has a run already: --resume, or another OUT", o->out);
    if (result == GSF_OK && has_state) {
        result = gsf_read_file(&t->ctx, name.text, &old, &size);
        if (result == GSF_OK && (size != text.size || memcmp(old, text.data, size) != 0))
            result = gsf_fail(&t->ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: the run had other settings", name.text);
    } else if (result == GSF_OK) result = gsf_write_file(&t->ctx, name.text, text.data, text.size);
    gsf_free(&t->ctx, old);
    gsf_destroy_buffer(&t->ctx, &text);
    return result;
}

static float* values_to_save(training* t) { return t->params.average ? t->params.average : t->params.value; }

// The transformer, each tensor in the dtype that it has in MODEL_DIR.
static gsf_result save_transformer(training* t) {
    const gsf_nn_weights* w = &t->net.weights;
    gsf_nn_tensor* all = (gsf_nn_tensor*)gsf_alloc(&t->ctx, w->tensor_count, sizeof *all);
    uint16_t* halves = (uint16_t*)gsf_alloc(&t->ctx, (size_t)t->params.count, sizeof *halves);
    gsf_result result = all && halves ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < w->tensor_count && result == GSF_OK; i++) {
        const int64_t at = t->params.at[i];
        all[i] = t->params.stored[i];
        if (at < 0) continue;
        const float* from = values_to_save(t) + at;
        if (all[i].dtype == GSF_NN_BF16 || all[i].dtype == GSF_NN_F16) {
            for (int64_t k = 0; k < all[i].count; k++)
                halves[at + k] = all[i].dtype == GSF_NN_BF16 ? gsf__float_to_bf16(from[k]) : gsf__float_to_half(from[k]);
            all[i].data = halves + at;
        } else {
            all[i].data = from;
            all[i].dtype = GSF_NN_F32;
        }
    }
    const path folder = join(t->o.out, "transformer");
    if (result == GSF_OK)
        result = gsf_nn_save_tensors(&t->ctx, join(folder.text, "diffusion_pytorch_model.safetensors").text, all,
                                     w->tensor_count);
    gsf_free(&t->ctx, all);
    gsf_free(&t->ctx, halves);
    return result;
}

static gsf_result save_model(training* t) {
    if (!t->o.lora) return save_transformer(t);
    return gsf__nn_save_params(&t->ctx, &t->params, t->params.average ? GSF__NN_SAVE_AVERAGE : GSF__NN_SAVE_VALUES,
                               join(t->o.out, "adapter_model.safetensors").text);
}

static gsf_result save_state(training* t) {
    const gsf_result result = training_save_log(&t->ctx, join(t->o.out, "training").text, "train_restorer", &t->log);
    if (result != GSF_OK) return result;
    return gsf__nn_save_params(&t->ctx, &t->params, GSF__NN_SAVE_STATE, join(t->o.out, "training.state").text);
}

// transformer/config.json and links to the parts that stay as they are.
static gsf_result lay_out_model(training* t) {
    static const char* const parts[] = {"vae", "scheduler", "text_encoder", "tokenizer", "dinov2", "vggt", "blip2"};
    const path folder = join(t->o.out, "transformer");
    void* config;
    size_t size;
    gsf_result result = need_folder(&t->ctx, folder.text);
    if (result == GSF_OK) result = gsf_read_file(&t->ctx, join(t->o.model, "transformer/config.json").text, &config, &size);
    if (result != GSF_OK) return result;
    result = gsf_write_file(&t->ctx, join(folder.text, "config.json").text, config, size);
    gsf_free(&t->ctx, config);
#if !defined(_WIN32)
    for (size_t i = 0; i < sizeof parts / sizeof *parts && result == GSF_OK; i++) {
        char* from = realpath(join(t->o.model, parts[i]).text, NULL);
        if (from && symlink(from, join(t->o.out, parts[i]).text) != 0 && errno != EEXIST)
            result = gsf_fail(&t->ctx, GSF_ERROR_IO, "%s/%s: %s", t->o.out, parts[i], strerror(errno));
        free(from);
    }
#else
    (void)parts; // links need rights there: copy them
#endif
    return result;
}

// ---- opening -----------------------------------------------------------------------

static gsf_result open_model(training* t) {
    gsf_context* ctx = &t->ctx;
    gsf_result result = gsf_nn_load_transformer(ctx, join(t->o.model, "transformer").text, &t->net);
    if (result == GSF_OK)
        result = gsf_nn_load_schedule(ctx, join(t->o.model, "scheduler/scheduler_config.json").text, &t->schedule);
    t->net.bf16 = t->o.bf16;
    t->frames = (t->net.sample_frames - 1) / (t->net.temporal_ratio ? t->net.temporal_ratio : 1) + 1;
    t->height = t->net.sample_height;
    t->width = t->net.sample_width;
    t->count = (size_t)t->frames * (size_t)t->net.out_channels * (size_t)t->height * (size_t)t->width;
    return result;
}

static int64_t trained_values(const training* t) {
    int64_t count = 0;
    for (size_t i = 0; i < t->net.weights.tensor_count; i++)
        if (gsf__dit_trains(t->net.weights.tensors[i].name)) count += t->net.weights.tensors[i].count;
    return count;
}

static void print_memory(training* t, int64_t trained, int64_t merged, int64_t tokens) {
    const gsf__dit_train_cost c = gsf__nn_query_training(&t->ctx, &t->net, trained, t->o.average > 0.0, t->frames, t->height,
                                                         t->width, tokens);
    const double sums = 4.0 * (double)trained * training_levels(t->o.groups / t->ranks.count), gib = 1024.0 * 1024.0 * 1024.0;
    fprintf(t->o.memory ? stdout : stderr,
            "memory: %.3f M parameters trained; %.3f GiB weights, gradients and moments, %.3f GiB sums of groups, %.3f GiB "
            "merged weights, %.3f GiB checkpoints, %.3f GiB of a block\n",
            1e-6 * (double)trained, c.weights / gib, sums / gib, 4.0 * (double)merged / gib, c.kept / gib, c.work / gib);
}

static gsf_result open_params(training* t) {
    gsf_context* ctx = &t->ctx;
    const path state = join(t->o.out, "training.state");
    gsf_result result = GSF_OK;
    if (t->o.lora) {
        if (t->ranks.rank == 0 && !is_there(state.text)) result = make_adapters(t);
        if (result == GSF_OK) training_wait(t->ranks);
        if (result == GSF_OK) result = gsf__lora_open(ctx, t->o.out, &t->net.weights, &t->lora);
    } else if (t->ranks.rank == 0) result = lay_out_model(t);
    if (result == GSF_OK)
        result = gsf__nn_make_params(ctx, t->o.lora ? &t->lora.file : &t->net.weights, t->o.lora ? NULL : gsf__dit_trains,
                                     t->o.average > 0.0, &t->params);
    if (result == GSF_OK && is_there(state.text)) result = gsf__nn_load_params(ctx, &t->params, state.text);
    if (result == GSF_OK && t->params.step)
        result = training_load_log(ctx, join(t->o.out, "training").text, t->params.step, &t->log);
    if (result == GSF_OK && t->o.lora) result = gsf__lora_merge(ctx, &t->lora);
    return result;
}

static gsf_result check_cached(training* t, const gsf_nn_weights* file, int64_t* most) {
    static const char* const names[6] = {"control", "deviation", "dino", "latents", "text", "vggt"};
    const gsf_nn_tensor* found[6];
    for (int i = 0; i < 6; i++) {
        found[i] = gsf_nn_find_tensor(file, names[i]);
        const int64_t count = found[i] ? found[i]->count : -1;
        const int is_latents = i == 0 || i == 1 || i == 3;
        const int64_t row = i == 2 ? t->net.dino_channels : i == 5 ? t->net.vggt_channels : 1;
        if (count < 0 || found[i]->dtype != GSF_NN_F32 || (is_latents && count != (int64_t)t->count) ||
            (i == 4 && count != 2 * (int64_t)t->net.text_tokens * t->net.text_channels) || count % row != 0 ||
            (i == 5 && count / row != found[2]->shape[0]))
            return gsf_fail(&t->ctx, GSF_ERROR_FORMAT, "%s: %s is missing or does not fit the model: delete it", file->name,
                            names[i]);
    }
    if (found[2]->shape[0] > *most) *most = found[2]->shape[0];
    return GSF_OK;
}

static gsf_result open_cache(training* t, int64_t* tokens) {
    gsf_result result = GSF_OK;
    t->cached = (gsf_nn_weights*)gsf_alloc_zeroed(&t->ctx, t->sequence_count, sizeof *t->cached);
    t->order = (size_t*)gsf_alloc(&t->ctx, t->sequence_count, sizeof *t->order);
    if (!t->cached || !t->order) return GSF_ERROR_OUT_OF_MEMORY;
    t->epoch = -1;
    for (size_t i = 0; i < t->sequence_count && result == GSF_OK; i++) {
        path name;
        result = cache_name(t, i, &name);
        if (result == GSF_OK) result = gsf_nn_load_weights(&t->ctx, name.text, NULL, &t->cached[i]);
        if (result == GSF_OK) result = check_cached(t, &t->cached[i], tokens);
    }
    return result;
}

static gsf_result make_examples(training* t, int64_t tokens) {
    const size_t n = (size_t)(t->o.batch / t->o.groups), text = (size_t)(t->net.text_tokens * t->net.text_channels);
    const size_t dino = (size_t)(tokens * t->net.dino_channels), vggt = (size_t)(tokens * t->net.vggt_channels);
    t->memory = (float*)gsf_alloc(&t->ctx, n, (3 * t->count + text + dino + vggt) * sizeof(float));
    t->examples = (example*)gsf_alloc_zeroed(&t->ctx, n, sizeof *t->examples);
    t->inputs = (gsf__dit_example*)gsf_alloc_zeroed(&t->ctx, n, sizeof *t->inputs);
    if (!t->memory || !t->examples || !t->inputs) return GSF_ERROR_OUT_OF_MEMORY;
    float* at = t->memory;
    for (size_t i = 0; i < n; i++) {
        example* e = &t->examples[i];
        e->latents = at;
        e->noise = e->latents + t->count;
        e->control = e->noise + t->count;
        e->text = e->control + t->count;
        e->dino = e->text + text;
        e->vggt = e->dino + dino;
        at = e->vggt + vggt;
    }
    return training_begin_sum(&t->ctx, t->ranks, t->o.groups, t->params.count, &t->sum);
}

// ---- training ----------------------------------------------------------------------

enum { DRAWS = 4, DRAW_CHOICES = 0, DRAW_NOISE, DRAW_POSTERIOR, ORDER_STREAM = 0x6f726465 };

// The sequence of the k-th example of a run: every epoch has all of them, in an order of its own.
static size_t sequence_of(training* t, int64_t k) {
    const int64_t count = (int64_t)t->sequence_count, epoch = k / count;
    if (epoch != t->epoch) {
        for (size_t i = 0; i < t->sequence_count; i++) t->order[i] = i;
        for (size_t i = t->sequence_count; i-- > 1;) {
            const size_t other = (size_t)(gsf_draw_uniform(t->o.seed + ORDER_STREAM, (uint64_t)epoch, i) * (double)(i + 1));
            const size_t kept = t->order[i];
            t->order[i] = t->order[other];
            t->order[other] = kept;
        }
        t->epoch = epoch;
    }
    return t->order[k % count];
}

typedef struct draw_job {
    uint64_t seed, stream;
    float *noise, *latents; // before: the deviation and the mean of the latents' posterior
    size_t count;
} draw_job;

enum { DRAW_PART = 4096 };

static void draw_part(void* arg, size_t part, int32_t worker) {
    const draw_job* j = (const draw_job*)arg;
    const size_t end = (part + 1) * DRAW_PART < j->count ? (part + 1) * DRAW_PART : j->count;
    (void)worker;
    for (size_t i = part * DRAW_PART; i < end; i++) {
        j->latents[i] += j->noise[i] * (float)gsf_draw_normal(j->seed, j->stream + DRAW_POSTERIOR, i);
        j->noise[i] = (float)gsf_draw_normal(j->seed, j->stream + DRAW_NOISE, i);
    }
}

static void copy_cached(const gsf_nn_weights* file, const char* name, int64_t first, int64_t count, float* to) {
    const gsf_nn_tensor* tensor = gsf_nn_find_tensor(file, name);
    gsf_nn_convert_tensor(tensor, first, count ? count : tensor->count, to);
}

// Example b of the batch, which depends on the seed, the step and b only.
static void draw_example(training* t, int b, const example* e, gsf__dit_example* in) {
    const int64_t k = t->params.step * t->o.batch + b;
    const uint64_t stream = (uint64_t)k * DRAWS;
    const gsf_nn_weights* file = &t->cached[sequence_of(t, k)];
    const int64_t text = (int64_t)t->net.text_tokens * t->net.text_channels;
    const int drops = gsf_draw_uniform(t->o.seed, stream, 1) < t->o.drop_references;
    const int negative = gsf_draw_uniform(t->o.seed, stream, 2) < t->o.drop_prompt;
    draw_job job = {t->o.seed, stream, e->noise, e->latents, t->count};
    memset(in, 0, sizeof *in);
    in->timestep = (int32_t)(gsf_draw_uniform(t->o.seed, stream, 0) * t->schedule.desc.train_steps);
    copy_cached(file, "latents", 0, 0, e->latents);
    copy_cached(file, "deviation", 0, 0, e->noise);
    copy_cached(file, "control", 0, 0, e->control);
    copy_cached(file, "text", negative ? 0 : text, text, e->text);
    gsf__parallel_for(&t->ctx, (t->count + DRAW_PART - 1) / DRAW_PART, draw_part, &job);
    in->latents = e->latents;
    in->noise = e->noise;
    in->control = e->control;
    in->text = e->text;
    if (drops) return;
    copy_cached(file, "dino", 0, 0, e->dino);
    copy_cached(file, "vggt", 0, 0, e->vggt);
    in->dino = e->dino;
    in->vggt = e->vggt;
    in->reference_tokens = gsf_nn_find_tensor(file, "dino")->shape[0];
}

static gsf_result train_batch(training* t, double* loss) {
    gsf__dit_train_desc desc;
    gsf_result result = GSF_OK;
    const int each = t->o.batch / t->o.groups;
    memset(&desc, 0, sizeof desc);
    desc.frames = t->frames;
    desc.height = t->height;
    desc.width = t->width;
    desc.batch = each;
    desc.examples = t->inputs;
    desc.schedule = &t->schedule;
    desc.lora = t->o.lora ? &t->lora : NULL;
    for (int g = 0; g < t->sum.own && result == GSF_OK; g++) {
        double part = 0.0;
        for (int i = 0; i < each; i++)
            draw_example(t, (t->ranks.rank * t->sum.own + g) * each + i, &t->examples[i], &t->inputs[i]);
        result = gsf__nn_train_transformer(&t->ctx, &t->net, &t->params, &desc, &part);
        if (result == GSF_OK) training_add_group(&t->sum, g, part, t->params.grad);
    }
    if (result == GSF_OK) *loss = training_add_ranks(&t->sum, t->params.grad) / t->o.groups;
    return result;
}

static gsf_result train(training* t) {
    gsf__nn_adam_desc adam;
    gsf_result result = GSF_OK;
    memset(&adam, 0, sizeof adam);
    adam.lr = t->o.rate;
    adam.weight_decay = t->o.decay;
    adam.max_norm = t->o.clip;
    adam.average = t->o.average;
    adam.warmup = t->o.warmup;
    adam.steps = t->o.cosine ? t->o.iterations : 0;
    adam.batches = t->o.groups;
    while (t->params.step < t->o.iterations && result == GSF_OK) {
        const double rate = gsf__nn_adam_rate(&adam, t->params.step);
        double loss = 0.0, norm = 0.0;
        result = train_batch(t, &loss);
        if (result == GSF_OK) result = gsf__nn_step_adam(&t->ctx, &t->params, &adam, &norm);
        if (result == GSF_OK && t->o.lora) result = gsf__lora_merge(&t->ctx, &t->lora);
        if (result == GSF_OK) result = training_keep_loss(&t->ctx, &t->log, loss);
        if (result != GSF_OK || t->ranks.rank != 0) continue;
        const int64_t step = t->params.step;
        if (step % 10 == 0 || step == t->o.iterations || step == 1)
            fprintf(stderr, "step %lld of %d, %.1f CPU minutes: loss %.5f, gradients %.3g, rate %.3g\n", (long long)step,
                    t->o.iterations, training_cpu_minutes(), loss, norm, rate);
        if (step % t->o.save_every == 0 || step == t->o.iterations) result = save_state(t);
        if (result == GSF_OK && step % t->o.save_every == 0) result = save_model(t);
    }
    if (result == GSF_OK && t->ranks.rank == 0) result = save_model(t);
    return result;
}

// ---- command line ------------------------------------------------------------------

static int usage(FILE* to) {
    fprintf(to,
            "usage: train_restorer OUT --model MODEL_DIR --data DATASET\n"
            "       [--lora RANK [--alpha RANK] [--targets to_q,to_k,to_v,to_out.0]]\n"
            "       [--iterations 10000] [--batch 8] [--groups 8] [--rate 2e-5] [--warmup 500] [--cosine]\n"
            "       [--weight-decay 0.01] [--clip 1] [--average 0] [--drop-references 0.1] [--drop-prompt 0.1]\n"
            "       [--seed 0] [--save-every 100] [--cache DIR] [--caption TEXT] [--threads N] [--bf16] [--resume] [--memory]\n"
            "Trains the transformer of the restorer dit, or adapters for it, on the sequences of gsfix dataset.\n");
    return to == stdout ? 0 : 2;
}

static int parse_options(int argc, char** argv, options* o) {
    for (int i = 1; i < argc; i++) {
        const char* name = argv[i];
        if (strcmp(name, "--resume") == 0) o->resume = 1;
        else if (strcmp(name, "--memory") == 0) o->memory = 1;
        else if (strcmp(name, "--cosine") == 0) o->cosine = 1;
        else if (strcmp(name, "--bf16") == 0) o->bf16 = 1;
        else if (name[0] != '-') {
            if (o->out) return 0;
            o->out = name;
        } else {
            const struct { const char* name; const char** to; } texts[] = {
                {"--model", &o->model}, {"--data", &o->data}, {"--cache", &o->cache}, {"--caption", &o->caption},
                {"--targets", &o->targets}};
            const struct { const char* name; int* to; } wholes[] = {
                {"--lora", &o->lora}, {"--iterations", &o->iterations}, {"--batch", &o->batch}, {"--groups", &o->groups},
                {"--warmup", &o->warmup}, {"--save-every", &o->save_every}, {"--threads", &o->threads}};
            const struct { const char* name; double* to; } reals[] = {
                {"--rate", &o->rate}, {"--alpha", &o->alpha}, {"--weight-decay", &o->decay}, {"--clip", &o->clip},
                {"--average", &o->average}, {"--drop-references", &o->drop_references}, {"--drop-prompt", &o->drop_prompt}};
            if (++i == argc) return 0;
            char* end = NULL;
            const double x = strtod(argv[i], &end);
            const int is_number = end != argv[i] && !*end && x >= 0.0 && x < 1e9;
            int known = 0;
            for (size_t k = 0; k < GSF__COUNT(texts); k++)
                if (strcmp(name, texts[k].name) == 0) *texts[k].to = argv[i], known = 1;
            for (size_t k = 0; k < GSF__COUNT(wholes) && is_number; k++)
                if (strcmp(name, wholes[k].name) == 0) *wholes[k].to = (int)x, known = 1;
            for (size_t k = 0; k < GSF__COUNT(reals) && is_number; k++)
                if (strcmp(name, reals[k].name) == 0) *reals[k].to = x, known = 1;
            if (is_number && strcmp(name, "--seed") == 0) o->seed = (uint64_t)x, known = 1;
            if (!known) return 0;
        }
    }
    if (o->alpha == 0.0) o->alpha = o->lora;
    if (!o->groups) // the largest power of two up to 8 that divides the batch
        for (o->groups = 8; o->batch > 0 && o->batch % o->groups;) o->groups /= 2;
    return o->model && (o->memory || (o->out && o->data)) && o->iterations > 0 && o->batch > 0 && o->batch <= 4096 &&
           training_is_power(o->groups) && o->batch % o->groups == 0 && o->save_every > 0 && o->average < 1.0 &&
           o->lora <= 4096 && o->drop_references <= 1.0 && o->drop_prompt <= 1.0;
}

static gsf_result run(training* t) {
    int64_t tokens = 0;
    gsf_result result = GSF_OK;
    if (t->o.memory) {
        const gsf_nn_transformer* n = &t->net;
        result = open_model(t);
        const double patches = rint(518.0 * n->sample_height / (n->sample_width ? n->sample_width : 1) / 14.0);
        if (result == GSF_OK) print_memory(t, trained_values(t), 0, 2 * 37 * (int64_t)(patches < 1.0 ? 1.0 : patches));
        return result;
    }
    if (t->ranks.rank == 0) {
        result = need_folder(&t->ctx, t->o.out);
        if (result == GSF_OK) result = list_data(t);
        if (result == GSF_OK) result = meet_settings(t);
        if (result == GSF_OK) result = encode_data(t);
    } else result = list_data(t);
    if (result == GSF_OK) training_wait(t->ranks);
    if (result == GSF_OK) result = open_model(t);
    if (result == GSF_OK) result = open_cache(t, &tokens);
    if (result == GSF_OK) result = open_params(t);
    if (result == GSF_OK) result = make_examples(t, tokens);
    if (result != GSF_OK) return result;
    int64_t merged = 0;
    for (size_t i = 0; i < t->lora.count; i++) merged += t->lora.pairs[i].stored.count;
    if (t->ranks.rank == 0) print_memory(t, t->params.count, merged, tokens);
    return train(t);
}

int main(int argc, char** argv) {
    static training t;
    path cache;
    const options defaults = {.targets = "to_q,to_k,to_v,to_out.0", .iterations = 10000, .batch = 8, .warmup = 500,
                              .save_every = 100, .rate = 2e-5, .decay = 0.01, .clip = 1.0, .drop_references = 0.1,
                              .drop_prompt = 0.1};
    t.o = defaults;
    if (argc == 2 && strcmp(argv[1], "--help") == 0) return usage(stdout);
    if (!parse_options(argc, argv, &t.o)) return usage(stderr);
    cache = join(t.o.out ? t.o.out : ".", "cache");
    if (!t.o.cache) t.o.cache = cache.text;
    t.ctx.threads = t.o.threads;
    gsf_result result = gsf_init_context(&t.ctx);
    t.ranks = training_begin(&t.ctx, &argc, &argv);
    if (result == GSF_OK) result = run(&t);
    if (result != GSF_OK)
        fprintf(stderr, "train_restorer: %s\n", t.ctx.error[0] ? t.ctx.error : "out of memory");
    training_end_sum(&t.ctx, &t.sum);
    gsf__nn_destroy_params(&t.ctx, &t.params);
    gsf__lora_destroy(&t.ctx, &t.lora);
    gsf_nn_destroy_schedule(&t.ctx, &t.schedule);
    gsf_nn_destroy_transformer(&t.ctx, &t.net);
    for (size_t i = 0; t.cached && i < t.sequence_count; i++) gsf_nn_destroy_weights(&t.ctx, &t.cached[i]);
    gsf_free(&t.ctx, t.cached);
    gsf_free(&t.ctx, t.order);
    gsf_free(&t.ctx, t.sequences);
    gsf_free(&t.ctx, t.memory);
    gsf_free(&t.ctx, t.examples);
    gsf_free(&t.ctx, t.inputs);
    gsf_free(&t.ctx, t.log.losses);
    return training_end(t.ranks, result == GSF_OK ? 0 : 1);
}
