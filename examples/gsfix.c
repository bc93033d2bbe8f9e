// gsfix.c - the toolkit's program: repairs 3D Gaussian Splatting scenes made from few photos. By hand, in one go:
//   cc -O2 -std=c11 -fopenmp -I. -DGSFIXER_IMPLEMENTATION -DGSFIX_ONE_FILE examples/gsfix.c -o gsfix -lm
//   (with Embree: -DGSF_USE_EMBREE and -lembree3 or -lembree4)
// SPDX-License-Identifier: MIT
#include "gsfix.h"

#include <errno.h>
#include <math.h>
#include <signal.h>
#include <stdarg.h>
#include <stddef.h>
#include <unistd.h>
#ifdef _WIN32
#include "gsfix_windows.h"
#endif

// ---- options ---------------------------------------------------------------------

typedef enum option_kind { FLAG, TEXT, WHOLE, REAL, SEED } option_kind;

typedef struct option_spec {
    const char* name;
    option_kind kind;
    size_t offset;
    double least, most;   // WHOLE, REAL
    const char* value;    // placeholder in --help; choices are separated by |
    const char* commands; // the commands that accept the option, separated by blanks
    const char* help;
} option_spec;

#define AT(field) offsetof(gsfix_options, field)
#define ALL "info fix render view convert filter path restore metrics masks dataset evaluate"
static const option_spec option_specs[] = {
    {"--out", TEXT, AT(out), 0, 0, "PATH", "fix render convert filter path restore masks dataset evaluate",
     "output folder (convert, path: output file), different from the inputs. Only files written by gsfix are ever replaced.\n"
     "path: transforms.json is written as nerfstudio's, images.txt as COLMAP's text, with cameras.txt and points3D.txt beside\n"
     "it; their photos are the pictures of `gsfix render --path`, in images/"},
    {"--views", TEXT, AT(views), 0, 0, "3|6|9|N|all|FILE", "fix view filter path masks info render",
     "training views: this many of the views that are not held out, all of them (default), or those named in FILE (one\n"
     "per line)"},
    {"--views", TEXT, AT(views), 0, 0, "3,6,9", "dataset",
     "numbers of reference views, each with splats and sequences of its own (default 3)"},
    {"--views", TEXT, AT(views), 0, 0, "3,6,9", "evaluate",
     "numbers of training views (default 3,6,9); restorers and trajectories are compared with the first of them"},
    {"--restorers", TEXT, AT(restorers), 0, 0, "LIST", "evaluate",
     "what is compared, separated by commas (default plain,none,warp): plain, 3DGS without regularisers; none, with\n"
     "regularisers for few views; warp, mini, dit:MODEL_DIR and exec:COMMAND, these and a restorer as for gsfix fix"},
    {"--trajectories", TEXT, AT(trajectories), 0, 0, "LIST", "evaluate",
     "camera paths of the frames to repair, of reference, ellipse, interpolate (default reference); several give the\n"
     "table that compares them"},
    {"--inits", TEXT, AT(inits), 0, 0, "LIST", "evaluate",
     "initial points, of tracks, default, embree, both, all, dense, random (default tracks, as in the paper; default is\n"
     "what gsfix fix does without --init)"},
    {"--conditions", TEXT, AT(conditions), 0, 0, "LIST", "evaluate",
     "dit: features of the photos that guide it, of none, 2d, 3d, both (default both); several give the table that\n"
     "compares them"},
    {"--seeds", WHOLE, AT(seeds), 1, 1000, "N", "evaluate",
     "run everything N times, from --seed on; tables have the mean and its standard error (default 1)"},
    {"--tables", TEXT, AT(tables), 0, 0, "LIST", "evaluate",
     "which tables to make, of restoration, reconstruction, conditions, trajectories (default: all that the lists allow)"},
    {"--benchmark", TEXT, AT(benchmark), 0, 0, "dl3dv|mipnerf360", "evaluate",
     "the scenes are those of this data set, by the names of their folders: the paper's printed figures stand beside ours"},
    {"--test-every", WHOLE, AT(test_every), 2, 1e9, "N", "fix filter path masks info render evaluate",
     "hold out every Nth view by name (default 8)"},
    {"--factor", WHOLE, AT(factor), 1, 64, "N", "info fix render filter path masks dataset evaluate",
     "use the photos in images_N/ or, if there are none, shrink them N times"},
    {"--max-size", WHOLE, AT(max_size), 16, 65536, "PIXELS", "info fix view render filter path masks dataset evaluate",
     "shrink photos whose longer side exceeds this"},
    {"--restorer", TEXT, AT(restorer), 0, 0, "none|warp|mini[:FILE]|dit:MODEL_DIR|exec:COMMAND", "fix restore",
     "what repairs the rendered frames (fix: none by default): warp reprojects the photos; mini is a small network that\n"
     "blends them (FILE: its weights, a safetensors file); dit is the paper's video diffusion model; exec is a program of\n"
     "yours, run as COMMAND JOBDIR"},
    {"--restorer", TEXT, AT(restorer), 0, 0, "none|warp|mini[:FILE]", "render",
     "clean up the renders with the training views (--views) of the scene: a filter, the splats stay as they are"},
    {"--filtered", FLAG, AT(filtered), 0, 0, NULL, "fix",
     "have the restorer clean up the final renders of the held-out views, too: filtered/, and figures of their own"},
    {"--copies", WHOLE, AT(copies), 1, 16, "N", "fix",
     "train N - 1 times more, with the seeds that follow, and join the copies, copies/1.ply to N.ply, which err differently and\n"
     "so less together; takes about N times as long (default 1)"},
    {"--with", TEXT, AT(with), 0, 0, "FILE,...", "render",
     "--restorer: splats of the same photos trained with other seeds; the frames are made from all of them"},
    {"--fixed-exposure", FLAG, AT(fixed_exposure), 0, 0, NULL, "fix render",
     "what the restorer cleans up (fix: with --filtered) keeps the exposure of the splats; by default, frames of warp and\n"
     "mini are exposed as the photos' camera would have, if that chose exposures by what it saw"},
    {"--restorer-timeout", REAL, AT(restorer_timeout), 0.1, 1e7, "SECONDS", "fix restore evaluate",
     "exec: time limit per window; a COMMAND that exceeds it is stopped and the run fails (default 3600)"},
    {"--condition", TEXT, AT(condition), 0, 0, "none|2d|3d|both", "fix restore",
     "dit: features of the photos that guide the model: 2d (semantic), 3d (geometric), both (default) or none"},
    {"--ref-features", TEXT, AT(ref_features), 0, 0, "FILE", "fix restore",
     "dit: encoded photos and prompts, a safetensors file with any of dino_latents.photoI, vggt_latents.photoI,J and\n"
     "prompt_embeds.clipK, indices from 0 (for a single clip also dino_latents, vggt_latents, prompt_embeds); missing\n"
     "tensors are computed by the model's encoders"},
    {"--save-features", TEXT, AT(save_features), 0, 0, "FILE", "fix restore",
     "dit: save the encoded photos and the prompts of all clips to a new file, for --ref-features"},
    {"--lora", TEXT, AT(lora), 0, 0, "PATH", "fix restore",
     "dit: low-rank adapters for its transformer, as peft or train_restorer --lora write them: a folder or its .safetensors"},
    {"--caption", TEXT, AT(caption), 0, 0, "TEXT", "fix restore evaluate",
     "dit: the prompt, a description of the scene (default: the model captions the first frame of each clip)"},
    {"--steps", WHOLE, AT(steps), 1, 1000, "N", "fix restore evaluate",
     "dit: denoising steps (default 50; with --quality fast 10)"},
    {"--solver", TEXT, AT(solver), 0, 0, "ddim|dpmpp|unipc", "fix restore evaluate",
     "dit: solver of the denoising steps (default ddim, as published; with --quality fast unipc)"},
    {"--caption", TEXT, AT(caption), 0, 0, "TEXT", "dataset", "what captions.json and the manifests say (default: empty)"},
    {"--guidance", REAL, AT(guidance), 1, 100, "G", "fix restore evaluate",
     "dit: scale of classifier-free guidance (default 6; 1 skips the unconditional pass and halves the work)"},
    {"--guidance-until", REAL, AT(guidance_until), 0.001, 1, "FRACTION", "fix restore evaluate",
     "dit: use guidance only in the first FRACTION of the steps (default 1)"},
    {"--strength", REAL, AT(strength), 0.001, 1, "FRACTION", "fix restore evaluate",
     "dit: start from the noised frames and run only the last FRACTION of the steps (default 1: from pure noise)"},
    {"--block-cache", REAL, AT(block_cache), 0, 10, "CHANGE", "fix restore evaluate",
     "dit: if the output of the first block changes by less than this (e.g. 0.1) from one step to the next, reuse the\n"
     "last output of all other blocks (default 0: never)"},
    {"--int8", FLAG, AT(int8), 0, 0, NULL, "fix restore evaluate",
     "dit: quantize most layers of the transformer to 8-bit integers; needs one byte of memory per weight"},
    {"--bf16", FLAG, AT(bf16), 0, 0, NULL, "fix restore evaluate",
     "dit: matrix products of the transformer and the encoders in bfloat16 where the processor has fast instructions for them\n"
     "(AMX, or AVX512_BF16, but not Intel's); implied by --quality fast"},
    {"--any-frames", FLAG, AT(any_frames), 0, 0, NULL, "fix restore evaluate",
     "dit: allow window lengths other than the 49 frames the model was trained on. Sinusoidal embeddings, which the model\n"
     "has never seen, then replace its learned positions"},
    {"--regularize", TEXT, AT(regularize), 0, 0, "on|off", "fix",
     "regularisers for few views (default on); off gives plain 3DGS, or with --set mcmc=1 plain MCMC, which has\n"
     "penalties of its own"},
    {"--regularize", TEXT, AT(regularize), 0, 0, "on|off", "dataset",
     "regularisers for few views (default off: plain 3DGS, as in the paper)"},
    {"--kinds", TEXT, AT(kinds), 0, 0, "LIST", "dataset",
     "where the artifacts come from, separated by commas (default sparse): sparse, splats trained on the reference views\n"
     "only; prune, scale, rotate, jitter, color, opacity, splats trained on all photos and then perturbed in this way; all"},
    {"--trajectory", TEXT, AT(trajectory), 0, 0, "reference|ellipse|interpolate|spread", "fix",
     "camera path of the frames to repair (default reference)"},
    {"--iterations", WHOLE, AT(iterations), 1, 1e7, "N", "fix view evaluate", "total number of training steps (default 1200)"},
    {"--init", TEXT, AT(init), 0, 0, "embree|tracks|both|all|dense|random", "fix",
     "initial points: those that a training view sees by ray (embree), by track (tracks) or by either (both); all points\n"
     "(all); those of both plus points of multi-view stereo between the training photos (dense, the default from two photos\n"
     "on); random points (random, the default if the scene has no points)"},
    {"--iterations", WHOLE, AT(iterations), 1, 1e7, "N", "dataset", "training steps for the reference views (default 1200)"},
    {"--clean-iterations", WHOLE, AT(clean_iterations), 1, 1e7, "N", "dataset",
     "training steps for the splats that are perturbed (default 3000)"},
    {"--init", TEXT, AT(init), 0, 0, "tracks|embree|both|random", "dataset",
     "initial points for the reference views (default tracks, as in the paper)"},
    {"--compare", FLAG, AT(compare), 0, 0, NULL, "fix",
     "also train the same number of steps from the same start and seed without repair, and report both runs: the\n"
     "difference is what the repair alone contributes"},
    {"--quality", TEXT, AT(quality), 0, 0, "fast|balanced|exact", "fix dataset evaluate",
     "approximations that are allowed (default balanced; exact allows none)"},
    {"--masks", TEXT, AT(masks), 0, 0, "DIR", "fix metrics",
     "DIR/VIEW.png for each held-out view: the \"seen\" figures are measured over the white pixels (see gsfix masks)"},
    {"--photo-masks", TEXT, AT(photo_masks), 0, 0, "on|off", "fix evaluate",
     "weight pixels by the photos' alpha and by SCENE/masks/NAME.png (or NAME.EXT.png): black pixels are neither trained\n"
     "on nor measured, grey ones count partially (default on)"},
    {"--background", TEXT, AT(background), 0, 0, "COLOR", "fix render view",
     "background colour: black, white, R,G,B from 0 to 1 or, in training, photos (a grey as bright as they are, the\n"
     "default unless --regularize is off) or random (a new one in each step); for splats by default that of the .ply file,\n"
     "or else black"},
    {"--resume", FLAG, AT(resume), 0, 0, NULL, "fix", "continue from OUT/checkpoint if there is one"},
    {"--resume", FLAG, AT(resume), 0, 0, NULL, "dataset evaluate", "go on with what an interrupted run has left in OUT"},
    {"--restart", FLAG, AT(restart), 0, 0, NULL, "fix",
     "start over even if OUT contains a checkpoint, which is then deleted"},
    {"--restart", FLAG, AT(restart), 0, 0, NULL, "dataset evaluate",
     "begin anew even if OUT contains a run's results or checkpoints"},
    {"--tasks", FLAG, AT(list_tasks), 0, 0, NULL, "dataset evaluate",
     "only print the names of the tasks (dataset: one per scene, evaluate: one per run), which gsfix_mpi distributes"},
    {"--task", TEXT, AT(task), 0, 0, "NAME", "dataset evaluate", "only do this task"},
    {"--eval-every", WHOLE, AT(eval_every), 1, 1e7, "N", "fix",
     "measure the held-out views every N steps (default: a tenth of the iterations)"},
    {"--checkpoint-every", WHOLE, AT(checkpoint_every), 1, 1e7, "N", "fix",
     "write OUT/checkpoint every N steps and after every repaired window (default: 20 times per run and after every\n"
     "window, but at most once a second and never so often that it takes more than 2 % of the time)"},
    {"--checkpoint-every", WHOLE, AT(checkpoint_every), 1, 1e7, "N", "dataset evaluate",
     "write the checkpoint of a scene or run every N training steps (default: once a minute, evaluate: as fix)"},
    {"--restorer", TEXT, AT(restorer), 0, 0, "none|warp|mini[:FILE]", "view",
     "what repairs the rendered frames while the scene is trained (default none)"},
    {"--screenshot", TEXT, AT(screenshot), 0, 0, "FILE.png", "view", "train to the end, save one picture, and leave"},
    {"--orbit", REAL, AT(orbit), -360, 360, "DEGREES", "view", "with --screenshot: go around this far before"},
    {"--spz-version", WHOLE, AT(spz_version), 2, 4, "N", "convert",
     "version of a .spz file (default 3; 4 is packed with zstd)"},
    {"--also", TEXT, AT(also), 0, 0, "LIST", "fix",
     "also write OUT/splats.splat (no view-dependent colour), splats.spz, splats.glb: a list of splat, spz, glb"},
    {"--set", TEXT, AT(settings), 0, 0, "NAME=VALUE,...", "fix dataset evaluate",
     "override individual settings of the trainer and of the repair loop:"},
    {"--frames", WHOLE, AT(frames), 2, 1e5, "N", "dataset evaluate",
     "frames per sequence, both references included: longer captures are thinned out evenly (default 49); the captures of\n"
     "fewer photos are used as they are"},
    {"--scene", TEXT, AT(scene), 0, 0, "SCENE", "render",
     "render the views of this scene; with --path, only its photos are used, by --restorer"},
    {"--path", TEXT, AT(path), 0, 0, "PATH.json", "fix render",
     "fix: repair frames at the cameras in this file, in every round, instead of on the path of --trajectory;\n"
     "render: render the cameras in this file"},
    {"--depth", FLAG, AT(depth), 0, 0, NULL, "render",
     "also write OUT/depth/NAME.npy (float32, scene units) and a colour-mapped image of it"},
    {"--depth-as", TEXT, AT(depth_as), 0, 0, "exr|png16", "render",
     "with --depth: also write OUT/depth/NAME.exr (float32, scene units), or OUT/depth16/NAME.png, 16-bit numbers that the\n"
     "factor in OUT/depth16/scale.json turns into scene units; 0 where there is nothing"},
    {"--alpha", FLAG, AT(alpha), 0, 0, NULL, "render", "also write OUT/alpha/NAME.png"},
    {"--video", TEXT, AT(video), 0, 0, "FILE", "fix render restore",
     "also write the frames as a video (fix: the repaired ones, window by window). FILE.mp4 and .webm are made by ffmpeg, if\n"
     "it is in PATH; .png, an animated PNG, lossless and large, and .html, a page that plays them, need nothing"},
    {"--fps", WHOLE, AT(fps), 1, 240, "N", "fix render restore", "frames per second of --video (default 24)"},
    {"--method", TEXT, AT(method), 0, 0, "embree|tracks|both", "filter",
     "keep the points that a training view sees by ray (embree), by track (tracks) or by either (both, the default)"},
    {"--kind", TEXT, AT(kind), 0, 0, "reference|ellipse|interpolate|spread", "path", "kind of path (default reference)"},
    {"--frames", WHOLE, AT(frames), 2, 1e6, "N", "path", "total number of cameras on the path (default 120)"},
    {"--windows", WHOLE, AT(windows), 1, 1e5, "N", "path", "number of clips the frames are divided into (default 1)"},
    {"--refs", TEXT, AT(refs), 0, 0, "A.png,B.png", "restore",
     "photos that guide the repair (default FRAMES_DIR/refs/)"},
    {"--which", TEXT, AT(which), 0, 0, "NAME,...", "metrics",
     "psnr, ssim_3dgs, ssim_torchmetrics, ssim_skimage, ms_ssim, ms_ssim_torchmetrics; with --models lpips_alex, lpips_vgg,\n"
     "lpips_squeeze on images in [-1,1], lpips_alex_raw ... on images in [0,1]. DIR_A as a clip: temporal_flickering; with\n"
     "--models motion_smoothness, overall_consistency (with --prompt), and against the first picture of DIR_B i2v_subject,\n"
     "i2v_background (default psnr,ssim_3dgs)"},
    {"--which", TEXT, AT(which), 0, 0, "NAME,...", "evaluate",
     "metrics of the tables besides PSNR and SSIM: lpips_vgg_raw (as published figures), and of restored sequences\n"
     "temporal_flickering, i2v_subject, i2v_background, motion_smoothness, overall_consistency (the last with --caption;\n"
     "default: all for which --models and --caption are given)"},
    {"--prompt", TEXT, AT(prompt), 0, 0, "TEXT", "metrics", "what DIR_A shows, for overall_consistency"},
    {"--models", TEXT, AT(models), 0, 0, "DIR", "metrics evaluate", "folder with the networks' weights, named as published"},
    {"--model", TEXT, AT(model), 0, 0, "ALL.ply", "masks", "splats of a good model, for example one trained on all views"},
    {"--threads", WHOLE, AT(threads), 1, 1024, "N", ALL,
     "number of workers (default: all cores); results are bit-identical for any number"},
    {"--seed", SEED, AT(seed), 0, 0, "S", ALL, "random seed (default 0)"},
    {"--json", FLAG, AT(json), 0, 0, NULL, ALL, "print one JSON object to stdout; progress always goes to stderr"},
    {"--help", FLAG, AT(help), 0, 0, NULL, ALL, "show this help"},
};
enum { OPTION_COUNT = sizeof option_specs / sizeof option_specs[0] };

static int run_info(gsfix_app* app);
static int run_render(gsfix_app* app);
static int run_convert(gsfix_app* app);
static int run_filter(gsfix_app* app);
static int run_path(gsfix_app* app);
static int run_restore(gsfix_app* app);
static int run_metrics(gsfix_app* app);
static int run_masks(gsfix_app* app);

typedef struct command_spec {
    const char *name, *usage, *summary;
    int inputs; // positional arguments; negative: at least that many
    int (*run)(gsfix_app* app);
} command_spec;

static const command_spec command_specs[] = {
    {"info", "SCENE | SPLATS.ply|.splat|.spz|.glb | MANIFEST.json",
     "print the contents of a scene, a splat file, or a manifest of gsfix dataset, whose files are checked", 1, run_info},
    {"fix", "SCENE --out DIR", "train splats on photos, repair them, and write a report", 1, gsfix_run_fix},
    {"render", "SPLATS.ply|.splat|.spz|.glb (--scene SCENE | --path PATH.json) --out DIR", "render splats to images", 1,
     run_render},
    {"view", "SPLATS | SCENE", "look around splats, or around a scene while it is trained", 1, gsfix_run_view},
    {"convert", "SPLATS --out SPLATS2", "write splats in another format: .ply, .splat, .spz or .glb, by the names", 1,
     run_convert},
    {"filter", "SCENE --out SCENE2", "write a COLMAP model with only the points that the training views see", 1,
     run_filter},
    {"path", "SCENE --out PATH.json", "sample a camera path through a scene", 1, run_path},
    {"restore", "FRAMES_DIR --restorer ... --out DIR", "repair one clip of frames", 1, run_restore},
    {"metrics", "DIR_A [DIR_B]", "compare images of the same name, or measure one folder as a clip", -1, run_metrics},
    {"masks", "SCENE --model ALL.ply --out DIR", "write, for each held-out view, the pixels that some training view sees",
     1, run_masks},
    {"dataset", "SCENE... --out DIR", "write paired sequences of artifact and clean frames, to train and judge restorers", -1,
     gsfix_run_dataset},
    {"evaluate", "SCENE... --out DIR", "make the paper's tables and a gallery: restorers, trajectories and starts compared", -1,
     gsfix_run_evaluate},
};
enum { COMMAND_COUNT = sizeof command_specs / sizeof command_specs[0] };

static int has_word(const char* words, const char* word) { // words: separated by single blanks
    const size_t n = strlen(word);
    for (const char* p = words; (p = strstr(p, word)) != NULL; p += n)
        if ((p == words || p[-1] == ' ') && (p[n] == 0 || p[n] == ' ')) return 1;
    return 0;
}

static const char* built_with(int is) { return is ? "yes" : "no"; }

static void print_version(void) {
    gsf_context ctx = {0};
    int embree = 0, openmp = 0, sdl = 0, zstd = 0, stb = 1;
    if (gsf_init_context(&ctx) != GSF_OK) return;
#ifdef GSF_USE_EMBREE
    embree = 1;
#endif
#ifdef _OPENMP
    openmp = 1;
#endif
#ifdef GSFIX_USE_SDL2
    sdl = 1;
#endif
#ifdef GSF_USE_ZSTD
    zstd = 1;
#endif
#ifdef GSF_NO_STB
    stb = 0;
#endif
    printf("gsfix %s  kernels: %s  workers: %d  visibility: %s\n", GSF_VERSION, gsf_describe_cpu_level(ctx.cpu_level),
           ctx.parallel.worker_count, embree ? "Embree" : "z-buffer (built without Embree)");
    // OpenImageIO is for hosts in C++, and this program is C.
    printf("built with  Embree: %s  OpenMP: %s  SDL2 (view): %s  zstd (SPZ 4): %s  stb (PNG, JPEG): %s  OpenImageIO: no\n",
           built_with(embree), built_with(openmp), built_with(sdl), built_with(zstd), built_with(stb));
#if defined(GSF_NO_SIMD)
    printf("instruction sets  scalar\n");
#elif defined(__x86_64__) || defined(_M_X64)
    printf("instruction sets  scalar, avx2, avx512, avx512_vnni, avx512_bf16, amx; chosen by the processor at start\n");
#elif defined(__aarch64__) || defined(__wasm_simd128__)
    printf("instruction sets  scalar, simd128\n");
#else
    printf("instruction sets  scalar\n");
#endif
}

static int print_overview(FILE* to) {
    fprintf(to, "gsfix %s - repairs 3D Gaussian Splatting scenes made from few photos\n\n", GSF_VERSION);
    for (int i = 0; i < COMMAND_COUNT; i++)
        if (command_specs[i].run) fprintf(to, "  gsfix %-8s %s\n", command_specs[i].name, command_specs[i].summary);
    fprintf(to, "\n  gsfix COMMAND --help lists its options; gsfix --version prints the version and build.\n"
                "  SCENE is a COLMAP folder (images/, sparse/0/) or a nerfstudio / instant-ngp transforms.json.\n"
                "  Exit status: 0 success, 1 failure (explained in one line), 2 usage error.\n");
    return to == stdout ? 0 : 2;
}

void gsfix_print_settings(FILE* to); // the names that --set accepts; in gsfix_fix.c

static void print_help(const command_spec* command) {
    printf("gsfix %s %s [options]\n%s\n\n", command->name, command->usage, command->summary);
    for (int i = 0; i < OPTION_COUNT; i++) {
        const option_spec* o = &option_specs[i];
        if (!has_word(o->commands, command->name)) continue;
        char left[96];
        snprintf(left, sizeof left, "%s%s%s", o->name, o->value ? " " : "", o->value ? o->value : "");
        printf("  %s\n", left);
        for (const char* line = o->help; *line;) {
            const int n = (int)strcspn(line, "\n");
            printf("        %.*s\n", n, line);
            line += n + (line[n] == '\n');
        }
        if (strcmp(o->name, "--set") == 0) gsfix_print_settings(stdout);
    }
}

static int is_choice(const char* choices, const char* value) {
    const size_t n = strlen(value);
    for (const char* p = choices; p; p = strchr(p, '|') ? strchr(p, '|') + 1 : NULL)
        if (strncmp(p, value, n) == 0 && (p[n] == 0 || p[n] == '|')) return 1;
    return 0;
}

static int set_option(gsfix_app* app, const option_spec* o, const char* value) {
    char* field = (char*)&app->o + o->offset;
    char* end = NULL;
    errno = 0;
    switch (o->kind) {
        case FLAG: *(int*)(void*)field = 1; return 0;
        case TEXT:
            if (!*value) return gsfix_misused(app, "%s is empty", o->name);
            if (strchr(o->value, '|') && !strpbrk(o->value, ":N") && !is_choice(o->value, value))
                return gsfix_misused(app, "%s %s: choose from %s", o->name, value, o->value);
            *(const char**)(void*)field = value;
            return 0;
        case WHOLE: {
            const long long x = strtoll(value, &end, 10);
            if (errno || end == value || *end || (double)x < o->least || (double)x > o->most)
                return gsfix_misused(app, "%s %s: expected a whole number from %.0f to %.0f", o->name, value, o->least,
                                     o->most);
            *(int*)(void*)field = (int)x;
            return 0;
        }
        case REAL: {
            const double x = strtod(value, &end);
            if (errno || end == value || *end || !(x >= o->least && x <= o->most))
                return gsfix_misused(app, "%s %s: expected a number from %g to %g", o->name, value, o->least, o->most);
            *(double*)(void*)field = x;
            return 0;
        }
        case SEED: {
            const unsigned long long x = strtoull(value, &end, 10);
            if (errno || end == value || *end || *value == '-')
                return gsfix_misused(app, "%s %s: expected a whole number", o->name, value);
            *(uint64_t*)(void*)field = x;
            return 0;
        }
    }
    return 2;
}

static int read_number(const char* text, long* out) {
    char* end = NULL;
    errno = 0;
    *out = strtol(text, &end, 10);
    return !errno && end != text && !*end;
}

static int parse_options(gsfix_app* app, const command_spec* command, int argc, char** argv) {
    for (int i = 2; i < argc; i++) {
        if (argv[i][0] != '-' || !argv[i][1]) {
            app->o.inputs[app->o.input_count++] = argv[i];
            continue;
        }
        const size_t length = strcspn(argv[i], "="); // --name value and --name=value
        const option_spec* o = NULL;
        for (int k = 0; k < OPTION_COUNT && !o; k++)
            if (strlen(option_specs[k].name) == length && strncmp(option_specs[k].name, argv[i], length) == 0 &&
                has_word(option_specs[k].commands, command->name))
                o = &option_specs[k];
        if (!o) return gsfix_misused(app, "no option %s here", argv[i]);
        const char* value = argv[i][length] ? argv[i] + length + 1 : NULL;
        if (o->kind == FLAG && value) return gsfix_misused(app, "%s takes no value", o->name);
        if (o->kind != FLAG && !value && ++i >= argc) return gsfix_misused(app, "%s needs %s", o->name, o->value);
        const int code = set_option(app, o, value ? value : o->kind == FLAG ? "" : argv[i]);
        if (code) return code;
    }
    if (app->o.help) return 0;
    if (command->inputs < 0 ? app->o.input_count < -command->inputs : app->o.input_count != command->inputs)
        return gsfix_misused(app, "expected: gsfix %s %s", command->name, command->usage);
    if (has_word("fix render filter path restore masks dataset evaluate", command->name) && !app->o.out)
        return gsfix_misused(app, "--out is missing");
    if (app->o.factor && app->o.max_size) return gsfix_misused(app, "--factor and --max-size exclude each other");
    if (app->o.resume && app->o.restart) return gsfix_misused(app, "--resume and --restart exclude each other");
    long wanted = 1;
    if (app->o.views && read_number(app->o.views, &wanted) && wanted < 1)
        return gsfix_misused(app, "--views %s: at least one is needed", app->o.views);
    return 0;
}

// ---- scenes and restorers --------------------------------------------------------

int gsfix_background(gsfix_app* app, const char* text, float out[3], gsf_background* kind) {
    const float grey = strcmp(text, "white") == 0 ? 1.0f : 0.0f;
    *kind = strcmp(text, "photos") == 0   ? GSF_BACKGROUND_PHOTOS
            : strcmp(text, "random") == 0 ? GSF_BACKGROUND_RANDOM
                                          : GSF_BACKGROUND_GIVEN;
    for (int c = 0; c < 3; c++) out[c] = grey;
    if (grey > 0.0f || *kind != GSF_BACKGROUND_GIVEN || strcmp(text, "black") == 0) return 0;
    const char* p = text;
    for (int c = 0; c < 3; c++) {
        char* end;
        out[c] = strtof(p, &end);
        if (end == p || !(out[c] >= 0.0f && out[c] <= 1.0f) || *end != (c < 2 ? ',' : 0))
            return gsfix_misused(app, "--background %s: not photos, black, white, random or R,G,B from 0 to 1", text);
        p = end + 1;
    }
    return 0;
}

int gsfix_splats_background(gsfix_app* app, float out[3]) {
    const char* text = app->o.background;
    gsf_background kind;
    const int code = text ? gsfix_background(app, text, out, &kind) : 0;
    if (code || !text || kind == GSF_BACKGROUND_GIVEN) return code;
    return gsfix_misused(app, "--background %s: for training only", text);
}

gsf_result gsfix_load_scene(gsfix_app* app, const char* path, gsf_scene* out) {
    gsf_scene_desc desc = {0};
    desc.factor = app->o.factor;
    desc.max_size = app->o.max_size;
    desc.no_masks = app->o.photo_masks && strcmp(app->o.photo_masks, "off") == 0;
    gsf_result result = gsf_splat_load_scene(&app->ctx, path, &desc, out);
    if (result != GSF_OK) return result;
    result = gsfix_add_scene_inputs(app, out);
    if (result != GSF_OK) gsf_splat_destroy_scene(&app->ctx, out);
    return result;
}

// Training views by name. Test views are every Nth view as usual, except those that are trained on.
static gsf_result split_by_file(gsfix_app* app, const gsf_scene* scene, const char* path, size_t test_every,
                                gsfix_split* split) {
    void* data;
    size_t size;
    gsf_result result = gsf_read_file(&app->ctx, path, &data, &size);
    if (result != GSF_OK) return result;
    uint8_t* chosen = (uint8_t*)gsf_alloc_zeroed(&app->ctx, scene->view_count + 1, 1);
    if (!chosen) result = GSF_ERROR_OUT_OF_MEMORY;
    const char* text = (const char*)data;
    const size_t mark = size >= 3 && memcmp(text, "\xef\xbb\xbf", 3) == 0 ? 3 : 0; // UTF-8 byte order mark
    for (size_t at = mark; at < size && result == GSF_OK;) {
        const size_t line = at;
        size_t end = at;
        while (end < size && text[end] != '\n') end++;
        at = end + 1;
        while (end > line && (text[end - 1] == '\r' || text[end - 1] == ' ')) end--;
        if (end == line) continue;
        size_t i = 0;
        while (i < scene->view_count &&
               !(strlen(scene->views[i].name) == end - line && memcmp(scene->views[i].name, text + line, end - line) == 0))
            i++;
        if (i < scene->view_count) chosen[i] = 1;
        else
            result = gsf_fail(&app->ctx, GSF_ERROR_INVALID_ARGUMENT, "%s:%zu: no view \"%.*s\" in the scene", path, line,
                              (int)(end - line < 200 ? end - line : 200), text + line);
    }
    if (result == GSF_OK) {
        size_t kept = 0;
        gsf_splat_split_views(scene->view_count, test_every, 0, NULL, NULL, split->test, &split->test_count);
        for (size_t i = 0; i < split->test_count; i++)
            if (!chosen[split->test[i]]) split->test[kept++] = split->test[i];
        split->test_count = kept;
        for (size_t i = 0; i < scene->view_count; i++)
            if (chosen[i]) split->train[split->train_count++] = (uint32_t)i;
    }
    gsf_free(&app->ctx, chosen);
    gsf_free(&app->ctx, data);
    return result;
}

gsf_result gsfix_split_scene(gsfix_app* app, const gsf_scene* scene, gsfix_split* out) {
    const size_t test_every = app->o.test_every ? (size_t)app->o.test_every : 8;
    const char* views = app->o.views ? app->o.views : "all";
    memset(out, 0, sizeof *out);
    out->train = (uint32_t*)gsf_alloc(&app->ctx, scene->view_count + 1, sizeof *out->train);
    out->test = (uint32_t*)gsf_alloc(&app->ctx, scene->view_count + 1, sizeof *out->test);
    gsf_result result = out->train && out->test ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    long wanted = 0;
    if (result == GSF_OK && (strcmp(views, "all") == 0 || read_number(views, &wanted))) {
        size_t most = 0;
        gsf_splat_split_views(scene->view_count, test_every, 0, NULL, &most, NULL, NULL);
        if ((size_t)wanted > most)
            result = gsf_fail(&app->ctx, GSF_ERROR_INVALID_ARGUMENT, "--views %s: only %zu views are not test views",
                              views, most);
        else
            gsf_splat_split_views(scene->view_count, test_every, (size_t)wanted, out->train, &out->train_count, out->test,
                                  &out->test_count);
    } else if (result == GSF_OK) {
        result = split_by_file(app, scene, views, test_every, out);
    }
    if (result == GSF_OK && out->train_count == 0)
        result =
            gsf_fail(&app->ctx, GSF_ERROR_INVALID_ARGUMENT, "no training view is left of %zu views", scene->view_count);
    if (result != GSF_OK) gsfix_free_split(app, out);
    return result;
}

void gsfix_free_split(gsfix_app* app, gsfix_split* split) {
    gsf_free(&app->ctx, split->train);
    gsf_free(&app->ctx, split->test);
    memset(split, 0, sizeof *split);
}

gsf_result gsfix_camera_list(gsfix_app* app, const gsf_scene* scene, const uint32_t* views, size_t count,
                             gsf_camera** out) {
    *out = (gsf_camera*)gsf_alloc(&app->ctx, count + 1, sizeof **out);
    if (!*out) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < count; i++) (*out)[i] = scene->views[views[i]].camera;
    return GSF_OK;
}

gsf_traj_kind gsfix_path_kind(const char* name) {
    return !name || strcmp(name, "reference") == 0 ? GSF_TRAJ_REFERENCE
           : strcmp(name, "ellipse") == 0          ? GSF_TRAJ_ELLIPSE
           : strcmp(name, "interpolate") == 0      ? GSF_TRAJ_INTERPOLATE
                                                   : GSF_TRAJ_SPREAD;
}

static int is_mini(const char* restorer) { // mini or mini:FILE
    return strcmp(restorer, "mini") == 0 || (strncmp(restorer, "mini:", 5) == 0 && restorer[5]);
}

int gsfix_check_restorer(gsfix_app* app) {
    const char* r = app->o.restorer;
    const gsfix_options* o = &app->o;
    if (r && strncmp(r, "dit:", 4) == 0 && r[4]) {
        return 0;
    }
    const char* alone = o->condition                ? "--condition"
                        : o->ref_features           ? "--ref-features"
                        : o->save_features          ? "--save-features"
                        : o->lora                   ? "--lora"
                        : o->caption                ? "--caption"
                        : o->steps                  ? "--steps"
                        : o->solver                 ? "--solver"
                        : o->guidance > 0.0         ? "--guidance"
                        : o->guidance_until > 0.0   ? "--guidance-until"
                        : o->strength > 0.0         ? "--strength"
                        : o->block_cache > 0.0      ? "--block-cache"
                        : o->int8                   ? "--int8"
                        : o->bf16                   ? "--bf16"
                        : o->any_frames             ? "--any-frames"
                                                    : NULL;
    if (alone) return gsfix_misused(app, "%s is for the restorer dit:MODEL_DIR", alone);
    if (!r || strcmp(r, "none") == 0 || strcmp(r, "warp") == 0 || is_mini(r)) return 0;
    if (strncmp(r, "exec:", 5) == 0 && r[5]) return 0;
    return gsfix_misused(app, "--restorer %s: choose from none|warp|mini[:FILE]|dit:MODEL_DIR|exec:COMMAND", r);
}

#ifndef GSFIX_MODELS // the folder of the weights that come with the source code
#define GSFIX_MODELS "examples/models"
#endif

// mini:FILE, else mini.safetensors in the folder named by the environment variable GSFIX_MODELS or in that of the source code
gsfix_path gsfix_mini_path(const char* restorer) {
    const char* folder = getenv("GSFIX_MODELS");
    if (restorer[4] == ':') return gsfix_pathf("%s", restorer + 5);
    return gsfix_pathf("%s/mini.safetensors", folder && folder[0] ? folder : GSFIX_MODELS);
}

const char* const gsfix_conditions[4] = {"both", "2d", "3d", "none"};
const char* const gsfix_solvers[3] = {"ddim", "dpmpp", "unipc"};

gsf_nn_dit_desc gsfix_dit_desc(const gsfix_app* app) {
    const gsfix_options* o = &app->o;
    const gsfix_quality* quality = gsfix_find_quality(o->quality);
    gsf_nn_dit_desc d;
    memset(&d, 0, sizeof d);
    d.model = o->restorer + 4;
    d.features = o->ref_features;
    d.save_features = o->save_features;
    d.lora = o->lora;
    d.keep_saved = o->resume;
    d.sample.any_frames = o->any_frames;
    d.caption = o->caption;
    for (int i = 0; i < 4; i++)
        if (o->condition && strcmp(o->condition, gsfix_conditions[i]) == 0) d.condition = (gsf_nn_condition)i;
    d.int8 = o->int8;
    d.bf16 = o->bf16 || quality->bf16;
    d.sample.solver = quality->solver;
    for (int i = 0; i < 3; i++)
        if (o->solver && strcmp(o->solver, gsfix_solvers[i]) == 0) d.sample.solver = (gsf_nn_solver)i;
    d.sample.steps = o->steps ? o->steps : quality->steps;
    d.sample.guidance = (float)o->guidance;
    d.sample.guidance_end = (float)o->guidance_until;
    d.sample.strength = (float)o->strength;
    d.sample.block_cache = (float)o->block_cache;
    d.sample.max_bytes = gsfix_physical_memory();
    return d;
}

// Assigns the time since the last report to this stage. Encoders may report before the first clip.
static void note_dit_stage(gsfix_app* app, const char* stage) {
    const double begin = app->stage_begin, memory = gsfix_anonymous_memory();
    const int is_clip = strcmp(stage, "clip") == 0;
    int i = 0;
    if (is_clip || begin > 0.0) app->stage_begin = gsfix_now();
    if (is_clip || begin == 0.0) return;
    if (strcmp(stage, "restore") == 0) stage = "solver"; // the part of a step outside the transformer
    while (i < app->stage_count && strcmp(app->stages[i].name, stage) != 0) i++;
    if (i == GSFIX_CLIP_STAGES) return;
    gsfix_clip_stage* s = &app->stages[i];
    if (i == app->stage_count) {
        snprintf(s->name, sizeof s->name, "%s", stage);
        app->stage_count++;
    }
    s->seconds += app->stage_begin - begin;
    if (memory > s->memory) s->memory = memory;
}

void gsfix_json_stages(gsfix_app* app, gsf_buffer* text) {
    gsf_context* ctx = &app->ctx;
    if (!app->stage_count) return;
    gsfix_json_begin(ctx, text, "restorer_stages", '[');
    for (int i = 0; i < app->stage_count; i++) {
        gsfix_json_begin(ctx, text, NULL, '{');
        gsfix_json_text(ctx, text, "name", app->stages[i].name);
        gsfix_json_number(ctx, text, "seconds", app->stages[i].seconds);
        gsfix_json_number(ctx, text, "memory_bytes", app->stages[i].memory);
        gsfix_json_end(ctx, text, '}');
    }
    gsfix_json_end(ctx, text, ']');
}

void gsfix_print_stages(gsfix_app* app) {
    for (int i = 0; i < app->stage_count; i++)
        gsfix_print(app, "  %-12s %8.2f s  %6.0f MiB", app->stages[i].name, app->stages[i].seconds,
                    app->stages[i].memory / (1 << 20));
}

// Steps of one clip: a progress bar if the clip is the whole job, otherwise one line every half minute.
static void show_dit_steps(void* user, const char* stage, double done, double total) {
    gsfix_app* app = (gsfix_app*)user;
    note_dit_stage(app, stage);
    if (strcmp(stage, "restore") != 0) return;
    if (strcmp(app->command, "restore") == 0) {
        gsfix_progress(app, done, total, "step %.0f of %.0f", done, total);
    } else if (done == 0.0) {
        app->clip_line = gsfix_now();
    } else if (gsfix_now() - app->clip_line >= 30.0) {
        gsfix_note(app, "restoring: step %.0f of %.0f", done, total);
        app->clip_line = gsfix_now();
    }
}

gsf_result gsfix_make_restorer(gsfix_app* app, gsf_restorer* out, int* present) {
    const char* r = app->o.restorer;
    memset(out, 0, sizeof *out);
    *present = r && strcmp(r, "none") != 0;
    if (!*present) return GSF_OK;
    if (strcmp(r, "warp") == 0) return gsf_splat_make_warp(&app->ctx, out);
    if (is_mini(r)) {
        gsf_nn_mini_desc desc;
        const gsfix_path path = gsfix_mini_path(r);
        memset(&desc, 0, sizeof desc);
        desc.path = path.s;
        return gsf_nn_make_mini(&app->ctx, &desc, out);
    }
    if (strncmp(r, "dit:", 4) == 0) {
        gsf_nn_dit_desc desc = gsfix_dit_desc(app);
        const gsfix_path checkpoint = gsfix_pathf("%s/dit.checkpoint", app->o.out);
        desc.sample.checkpoint = checkpoint.s;
        app->ctx.progress.progress_fn = show_dit_steps;
        app->ctx.progress.user = app;
        return gsf_nn_make_dit(&app->ctx, &desc, out);
    }
    return gsfix_make_exec(app, r + 5, app->o.restorer_timeout > 0.0 ? app->o.restorer_timeout : 3600.0, out);
}

gsf_result gsfix_drop_dit_checkpoint(gsfix_app* app) { // and the checkpoints of the clip's other parts
    gsf_result result = gsfix_remove_output(app, "dit.checkpoint");
    for (int part = 1; result == GSF_OK && gsfix_has_output(app, gsfix_pathf("dit.checkpoint.%d", part).s); part++)
        result = gsfix_remove_output(app, gsfix_pathf("dit.checkpoint.%d", part).s);
    return result;
}

// ---- info ------------------------------------------------------------------------

static int compare_doubles(const void* a, const void* b) {
    const double x = *(const double*)a, y = *(const double*)b;
    return x < y ? -1 : x > y;
}

// Bounds of the middle 98 % of the points.
static void print_box(gsfix_app* app, const char* key, const double* points, size_t count) {
    double low[3] = {0}, high[3] = {0};
    double* column = (double*)gsf_alloc(&app->ctx, count + 1, sizeof *column);
    if (!column || !count) {
        gsf_free(&app->ctx, column);
        return;
    }
    for (int a = 0; a < 3; a++) {
        for (size_t i = 0; i < count; i++) column[i] = points[3 * i + (size_t)a];
        qsort(column, count, sizeof *column, compare_doubles);
        low[a] = column[count / 100];
        high[a] = column[count - 1 - count / 100];
    }
    gsf_free(&app->ctx, column);
    gsfix_json_begin(&app->ctx, &app->json, key, '[');
    for (int a = 0; a < 6; a++) gsfix_json_number(&app->ctx, &app->json, NULL, a < 3 ? low[a] : high[a - 3]);
    gsfix_json_end(&app->ctx, &app->json, ']');
    gsfix_print(app, "extent     %.4g..%.4g  %.4g..%.4g  %.4g..%.4g (middle 98 %% of the points)", low[0], high[0], low[1],
                high[1], low[2], high[2]);
}

static gsf_result info_scene(gsfix_app* app) {
    gsf_scene scene;
    gsfix_split split;
    gsf_result result = gsfix_load_scene(app, app->o.inputs[0], &scene);
    if (result != GSF_OK) return result;
    result = gsfix_split_scene(app, &scene, &split);
    if (result != GSF_OK) {
        gsf_splat_destroy_scene(&app->ctx, &scene);
        return result;
    }
    gsf_context* ctx = &app->ctx;
    gsf_buffer* json = &app->json;
    int32_t least[2] = {0}, most[2] = {0};
    for (size_t i = 0; i < scene.view_count; i++) {
        const int32_t size[2] = {scene.views[i].camera.width, scene.views[i].camera.height};
        for (int k = 0; k < 2; k++) {
            if (i == 0 || size[k] < least[k]) least[k] = size[k];
            if (size[k] > most[k]) most[k] = size[k];
        }
    }
    gsfix_json_text(ctx, json, "kind", "scene");
    gsfix_json_number(ctx, json, "views", (double)scene.view_count);
    gsfix_json_number(ctx, json, "train_views", (double)split.train_count);
    gsfix_json_number(ctx, json, "test_views", (double)split.test_count);
    gsfix_json_number(ctx, json, "width", most[0]);
    gsfix_json_number(ctx, json, "height", most[1]);
    gsfix_json_number(ctx, json, "points", (double)scene.point_count);
    const size_t entries = scene.point_count ? scene.track_begin[scene.point_count] : 0;
    gsfix_json_number(ctx, json, "track_entries", (double)entries);
    gsfix_print(app, "scene      %s", app->o.inputs[0]);
    gsfix_print(app, "views      %zu: %zu to train on, %zu held out", scene.view_count, split.train_count,
                split.test_count);
    if (least[0] == most[0] && least[1] == most[1])
        gsfix_print(app, "size       %d x %d pixels", (int)most[0], (int)most[1]);
    else gsfix_print(app, "size       %d..%d x %d..%d pixels", (int)least[0], (int)most[0], (int)least[1], (int)most[1]);
    if (scene.view_count)
        gsfix_print(app, "focal      %.1f, %.1f pixels (first view)", scene.views[0].camera.fx, scene.views[0].camera.fy);
    gsfix_print(app, "points     %zu%s", scene.point_count, scene.point_count ? "" : " (training starts from random ones)");
    if (scene.point_count)
        gsfix_print(app, entries ? "tracks     %.2f views per point" : "tracks     none",
                    (double)entries / (double)scene.point_count);
    print_box(app, "extent", scene.points, scene.point_count);
    gsfix_json_begin(ctx, json, "names", '[');
    for (size_t i = 0; i < scene.view_count; i++) gsfix_json_text(ctx, json, NULL, scene.views[i].name);
    gsfix_json_end(ctx, json, ']');
    for (int k = 0; k < 2; k++) {
        gsfix_json_begin(ctx, json, k ? "test" : "train", '[');
        for (size_t i = 0; i < (k ? split.test_count : split.train_count); i++)
            gsfix_json_text(ctx, json, NULL, scene.views[k ? split.test[i] : split.train[i]].name);
        gsfix_json_end(ctx, json, ']');
    }
    gsfix_free_split(app, &split);
    gsf_splat_destroy_scene(ctx, &scene);
    return GSF_OK;
}

static gsf_result info_splats(gsfix_app* app) {
    gsf_splats s;
    gsf_result result = gsf_splat_load(&app->ctx, app->o.inputs[0], &s);
    if (result != GSF_OK) return result;
    double* world = (double*)gsf_alloc(&app->ctx, s.count + 1, 3 * sizeof *world);
    double* column = (double*)gsf_alloc(&app->ctx, s.count + 1, sizeof *column);
    result = world && column ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK) {
        gsf_buffer* json = &app->json;
        gsfix_json_text(&app->ctx, json, "kind", "splats");
        gsfix_json_number(&app->ctx, json, "splats", (double)s.count);
        gsfix_json_number(&app->ctx, json, "sh_degree", s.sh_degree);
        gsfix_json_bool(&app->ctx, json, "antialiased", s.antialiased);
        gsfix_json_begin(&app->ctx, json, "background", '[');
        for (int c = 0; c < 3; c++) gsfix_json_number(&app->ctx, json, NULL, (double)s.background[c]);
        gsfix_json_end(&app->ctx, json, ']');
        gsfix_print(app, "splats     %zu of SH degree %d%s", s.count, (int)s.sh_degree, s.antialiased ? ", antialiased" : "");
        for (size_t i = 0; i < 3 * s.count; i++) world[i] = (double)s.means[i] + s.origin[i % 3];
        print_box(app, "extent", world, s.count);
        size_t opaque = 0, faint = 0;
        for (size_t i = 0; i < s.count; i++) {
            const double opacity = 1.0 / (1.0 + exp(-(double)s.opacity_logits[i]));
            opaque += opacity > 0.9;
            faint += opacity < 0.005;
            column[i] =
                exp(((double)s.log_scales[3 * i] + (double)s.log_scales[3 * i + 1] + (double)s.log_scales[3 * i + 2]) /
                    3.0);
        }
        if (s.count) {
            qsort(column, s.count, sizeof *column, compare_doubles);
            gsfix_json_number(&app->ctx, json, "median_scale", column[s.count / 2]);
            gsfix_json_number(&app->ctx, json, "opaque_share", (double)opaque / (double)s.count);
            gsfix_json_number(&app->ctx, json, "faint_share", (double)faint / (double)s.count);
            gsfix_print(app, "scale      median %.4g, 1 %% below %.3g, 1 %% above %.3g", column[s.count / 2],
                        column[s.count / 100], column[s.count - 1 - s.count / 100]);
            gsfix_print(app, "opacity    %.1f %% above 0.9, %.1f %% below 0.005", 100.0 * (double)opaque / (double)s.count,
                        100.0 * (double)faint / (double)s.count);
        }
        if (s.origin[0] != 0.0 || s.origin[1] != 0.0 || s.origin[2] != 0.0)
            gsfix_print(app, "origin     %.17g %.17g %.17g", s.origin[0], s.origin[1], s.origin[2]);
    }
    gsf_free(&app->ctx, world);
    gsf_free(&app->ctx, column);
    gsf_splat_destroy(&app->ctx, &s);
    return result;
}

static int run_info(gsfix_app* app) {
    const char* path = app->o.inputs[0];
    const char* ending = strrchr(path, '.');
    const int is_splats = ending && !gsfix_is_folder(path) &&
                          (strcmp(ending, ".ply") == 0 || strcmp(ending, ".splat") == 0 || strcmp(ending, ".spz") == 0 ||
                           strcmp(ending, ".glb") == 0);
    const int is_manifest = ending && strcmp(ending, ".json") == 0 && gsfix_is_manifest(path);
    const gsf_result result = is_splats     ? info_splats(app)
                              : is_manifest ? gsfix_info_dataset(app, path)
                                            : info_scene(app);
    return result == GSF_OK ? 0 : gsfix_failed(app);
}

// ---- render ----------------------------------------------------------------------

static int depth_is_exr(const gsfix_app* app) { return app->o.depth_as && strcmp(app->o.depth_as, "exr") == 0; }
static int depth_is_png(const gsfix_app* app) { return app->o.depth_as && strcmp(app->o.depth_as, "png16") == 0; }

// Scene units per step of 16-bit depth, the same for all pictures: the farthest splat of any camera fits. 1, 2 or 5 times a
// power of ten.
static double depth_step(const gsf_splats* s, const gsf_camera* cameras, size_t stride, size_t count) {
    static const double digits[3] = {1.0, 2.0, 5.0};
    double most = 0.0, step = 1e-9;
    for (size_t i = 0; i < count; i++) {
        const double* m = ((const gsf_camera*)((const char*)cameras + i * stride))->w2c;
        for (size_t k = 0; k < s->count; k++) {
            double z = m[14];
            for (size_t a = 0; a < 3; a++) z += m[4 * a + 2] * (s->origin[a] + (double)s->means[3 * k + a]);
            if (z > most) most = z;
        }
    }
    for (int i = -26; step * 65535.0 < most && i < 90; i++) { // the nearest doubles to 2e-9, 5e-9, 1e-8 ...
        const int power = (i + 99) / 3 - 33;
        const double digit = digits[(i + 99) % 3];
        step = power < 0 ? digit / pow(10.0, -power) : digit * pow(10.0, power);
    }
    return step;
}

static gsf_result save_depth_16(gsfix_app* app, const gsf_image* depth, const char* name) {
    gsf_image steps;
    gsf_result result = gsf_make_image(&app->ctx, GSF_U16, depth->width, depth->height, 1, &steps);
    if (result != GSF_OK) return result;
    for (int64_t i = 0; i < depth->width * depth->height; i++) {
        const double value = floor((double)((const float*)depth->data)[i] / app->depth_step + 0.5);
        ((uint16_t*)steps.data)[i] = (uint16_t)(value < 0.0 ? 0.0 : value > 65535.0 ? 65535.0 : value);
    }
    result = gsf_save_image(&app->ctx, gsfix_pathf("%s/depth16/%s.png", app->o.out, name).s, &steps);
    gsf_destroy_image(&app->ctx, &steps);
    return result;
}

// Writes one image (and depth, alpha) to the output folders; buffers grow to the size of the largest camera.
static gsf_result render_one(gsfix_app* app, gsf_rasterizer* rasterizer, const gsf_splats* splats, const gsf_camera* camera,
                             const gsf_render_desc* desc, const char* name, gsfix_video* video) {
    gsf_context* ctx = &app->ctx;
    const char* out = app->o.out;
    gsf_render_output images = {0};
    gsf_image picture = {0};
    gsf_result result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 3, &images.color);
    if (result == GSF_OK && app->o.depth)
        result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 1, &images.depth);
    if (result == GSF_OK && app->o.alpha)
        result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 1, &images.alpha);
    if (result == GSF_OK) result = gsf_splat_render(ctx, rasterizer, splats, camera, desc, &images);
    if (result == GSF_OK) result = gsf_save_image(ctx, gsfix_pathf("%s/%s.png", out, name).s, &images.color);
    if (result == GSF_OK) result = gsfix_add_frame(video, &images.color);
    if (result == GSF_OK && app->o.depth) {
        result = gsfix_save_npy(ctx, gsfix_pathf("%s/depth/%s.npy", out, name).s, &images.depth);
        if (result == GSF_OK) result = gsfix_color_depth(ctx, &images.depth, &picture);
        if (result == GSF_OK) result = gsf_save_image(ctx, gsfix_pathf("%s/depth/%s.png", out, name).s, &picture);
        images.depth.color_space = GSF_COLOR_LINEAR; // numbers, which EXR keeps
        if (result == GSF_OK && depth_is_exr(app))
            result = gsf_save_image(ctx, gsfix_pathf("%s/depth/%s.exr", out, name).s, &images.depth);
        if (result == GSF_OK && depth_is_png(app)) result = save_depth_16(app, &images.depth, name);
    }
    if (result == GSF_OK && app->o.alpha)
        result = gsf_save_image(ctx, gsfix_pathf("%s/alpha/%s.png", out, name).s, &images.alpha);
    gsf_destroy_image(ctx, &picture);
    gsf_destroy_image(ctx, &images.color);
    gsf_destroy_image(ctx, &images.depth);
    gsf_destroy_image(ctx, &images.alpha);
    return result;
}

static gsfix_path frame_name(const gsf_scene* scene, size_t i) { // scene NULL: the camera belongs to a path
    return scene ? gsfix_view_stem(scene, i) : gsfix_pathf("%05zu", i);
}

static gsf_result open_render_out(gsfix_app* app, const gsf_scene* scene, size_t count) {
    gsf_result result = GSF_OK;
    for (size_t i = 0; i < count && result == GSF_OK; i++) {
        const gsfix_path name = frame_name(scene, i);
        result = gsfix_claim(app, "%s.png", name.s);
        if (result == GSF_OK && app->o.depth) result = gsfix_claim(app, "depth/%s.npy", name.s);
        if (result == GSF_OK && app->o.depth) result = gsfix_claim(app, "depth/%s.png", name.s);
        if (result == GSF_OK && depth_is_exr(app)) result = gsfix_claim(app, "depth/%s.exr", name.s);
        if (result == GSF_OK && depth_is_png(app)) result = gsfix_claim(app, "depth16/%s.png", name.s);
        if (result == GSF_OK && app->o.alpha) result = gsfix_claim(app, "alpha/%s.png", name.s);
    }
    if (result == GSF_OK && depth_is_png(app)) result = gsfix_claim(app, "depth16/scale.json");
    if (result == GSF_OK) result = gsfix_open_out(app);
    if (result == GSF_OK) result = gsfix_claim_file(app, app->o.video);
    return result == GSF_OK ? gsfix_remove_stale(app) : result;
}

static gsf_result save_depth_step(gsfix_app* app) {
    gsf_buffer text = {0};
    gsf_append_text(&app->ctx, &text, "{\"units_per_step\":");
    gsf_append_json_number(&app->ctx, &text, app->depth_step);
    gsf_append_text(&app->ctx, &text, "}\n");
    const gsf_result result =
        text.failed ? GSF_ERROR_OUT_OF_MEMORY
                    : gsf_write_file(&app->ctx, gsfix_pathf("%s/depth16/scale.json", app->o.out).s, text.data, text.size);
    gsf_destroy_buffer(&app->ctx, &text);
    return result;
}

// A fixer that trains nothing, with the training views of the scene as references and a restorer.
typedef struct render_filter {
    gsfix_split split;
    gsf_train_view* views;
    gsf_restorer restorer;
    gsf_fixer* fixers[GSFIX_COPIES_MOST]; // of the splats, and of those of --with
    size_t fixer_count;
} render_filter;

static gsf_result add_to_filter(gsfix_app* app, gsf_scene* scene, const gsf_splats* splats, const gsf_render_desc* desc,
                                render_filter* f) {
    gsf_fix_desc fix = gsf_splat_resolve_few_view_desc(scene, f->split.train_count, GSF_QUALITY_BALANCED);
    fix.train.render = *desc;
    fix.train.render.antialiased = splats->antialiased;
    if (!app->o.background) memcpy(fix.train.render.background, splats->background, sizeof splats->background);
    if (app->o.fixed_exposure) fix.auto_exposure = -1.0f;
    fix.train.seed = app->o.seed;
    return gsf_splat_make_fixer(&app->ctx, &fix, f->views, f->split.train_count, splats, &f->restorer,
                                &f->fixers[f->fixer_count++]);
}

static gsf_result open_filter(gsfix_app* app, gsf_scene* scene, const gsf_splats* splats, const gsf_render_desc* desc,
                              render_filter* f) {
    int present;
    gsf_result result = gsfix_split_scene(app, scene, &f->split);
    if (result == GSF_OK) result = gsfix_make_restorer(app, &f->restorer, &present);
    if (result == GSF_OK)
        result = gsf_splat_load_train_views(&app->ctx, scene, f->split.train, f->split.train_count, &f->views);
    if (result == GSF_OK) result = add_to_filter(app, scene, splats, desc, f);
    for (const char* p = app->o.with ? app->o.with : ""; *p && result == GSF_OK; p += *p == ',') {
        const gsfix_path path = gsfix_pathf("%.*s", (int)strcspn(p, ","), p);
        gsf_splats copy = {0};
        p += strcspn(p, ",");
        if (f->fixer_count == GSFIX_COPIES_MOST)
            return gsf_fail(&app->ctx, GSF_ERROR_INVALID_ARGUMENT, "--with: more than %d files", GSFIX_COPIES_MOST - 1);
        result = gsf_splat_load(&app->ctx, path.s, &copy);
        if (result == GSF_OK) result = add_to_filter(app, scene, &copy, desc, f);
        gsf_splat_destroy(&app->ctx, &copy);
    }
    return result;
}

static void close_filter(gsfix_app* app, render_filter* f) {
    for (size_t i = 0; i < f->fixer_count; i++) gsf_splat_destroy_fixer(&app->ctx, f->fixers[i]);
    gsf_destroy_restorer(&app->ctx, &f->restorer);
    gsf_free(&app->ctx, f->views);
    gsfix_free_split(app, &f->split);
}

// Replaces a render by what the restorer makes of it.
static gsf_result filter_one(gsfix_app* app, const render_filter* f, const gsf_camera* camera, const char* name,
                             gsfix_video* video) {
    gsf_context* ctx = &app->ctx;
    gsf_image color, confidence = {0};
    gsf_result result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 3, &color);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 1, &confidence);
    if (result == GSF_OK) result = gsf_splat_restore_views(ctx, f->fixers, f->fixer_count, camera, 1, &color, &confidence);
    if (result == GSF_OK) result = gsf_save_image(ctx, gsfix_pathf("%s/%s.png", app->o.out, name).s, &color);
    if (result == GSF_OK) result = gsfix_add_frame(video, &color);
    gsf_destroy_image(ctx, &color);
    gsf_destroy_image(ctx, &confidence);
    return result;
}

// cameras: `stride` bytes apart.
static gsf_result begin_render_video(gsfix_app* app, const gsf_camera* cameras, size_t stride, size_t count,
                                     gsfix_video** out) {
    int64_t width = 0, height = 0;
    for (size_t i = 0; i < count; i++) {
        const gsf_camera* camera = (const gsf_camera*)((const char*)cameras + i * stride);
        if (camera->width > width) width = camera->width;
        if (camera->height > height) height = camera->height;
    }
    return gsfix_begin_video(app, width, height, count, out);
}

static gsf_result render_all(gsfix_app* app, const float* background) { // NULL: that of the splats
    gsf_context* ctx = &app->ctx;
    gsf_scene scene = {0};
    gsf_splats splats = {0};
    gsf_camera* path = NULL;
    gsf_rasterizer* rasterizer = NULL;
    render_filter filter = {0};
    gsfix_video* video = NULL;
    const int filtered = app->o.restorer && strcmp(app->o.restorer, "none") != 0;
    size_t count = 0;
    double seconds = 0.0;
    gsf_render_desc desc = {0};
    gsf_result result = gsf_splat_load(ctx, app->o.inputs[0], &splats);
    desc.antialiased = splats.antialiased;
    memcpy(desc.background, background ? background : splats.background, sizeof desc.background);
    if (result == GSF_OK && app->o.scene) result = gsfix_load_scene(app, app->o.scene, &scene);
    if (result == GSF_OK && app->o.path) result = gsf_load_cameras(ctx, app->o.path, &path, &count);
    if (result == GSF_OK && !app->o.path) count = scene.view_count;
    if (result == GSF_OK && count)
        desc.near_plane = app->o.scene ? gsf_splat_measure_near_plane(&scene.views[0].camera, sizeof scene.views[0],
                                                                      scene.view_count)
                                       : gsf_splat_measure_near_plane(path, sizeof *path, count);
    if (result == GSF_OK) result = open_render_out(app, app->o.path ? NULL : &scene, count);
    if (result == GSF_OK && depth_is_png(app) && count) {
        app->depth_step = app->o.path ? depth_step(&splats, path, sizeof *path, count)
                                      : depth_step(&splats, &scene.views[0].camera, sizeof scene.views[0], count);
        result = save_depth_step(app);
    }
    if (result == GSF_OK && filtered) result = open_filter(app, &scene, &splats, &desc, &filter);
    if (result == GSF_OK) result = gsf_splat_make_rasterizer(ctx, &rasterizer);
    if (result == GSF_OK)
        result = app->o.path ? begin_render_video(app, path, sizeof *path, count, &video)
                             : begin_render_video(app, &scene.views[0].camera, sizeof scene.views[0], count, &video);
    gsfix_json_begin(ctx, &app->json, "frames", '[');
    for (size_t i = 0; i < count && result == GSF_OK; i++) {
        const gsfix_path name = frame_name(app->o.path ? NULL : &scene, i);
        const gsf_camera* camera = app->o.path ? path + i : &scene.views[i].camera;
        const double begin = gsfix_now();
        result = gsf_is_cancelled(ctx) ? gsf_fail(ctx, GSF_ERROR_CANCELLED, "stopped after %zu of %zu frames", i, count)
                                       : render_one(app, rasterizer, &splats, camera, &desc, name.s, filtered ? NULL : video);
        if (result == GSF_OK && filtered) result = filter_one(app, &filter, camera, name.s, video);
        seconds += gsfix_now() - begin;
        gsfix_json_text(ctx, &app->json, NULL, gsfix_pathf("%s.png", name.s).s);
        gsfix_progress(app, (double)(i + 1), (double)count, "frame %zu of %zu", i + 1, count);
    }
    gsfix_json_end(ctx, &app->json, ']');
    gsfix_json_number(ctx, &app->json, "seconds", seconds);
    if (result == GSF_OK) result = gsfix_finish_video(video);
    gsfix_destroy_video(video);
    if (result == GSF_OK && app->o.video) gsfix_json_text(ctx, &app->json, "video", app->o.video);
    if (result == GSF_OK)
        gsfix_print(app, "%zu frames of %zu splats in %.2f s, files included -> %s%s%s", count, splats.count, seconds,
                    app->o.out, app->o.video ? ", " : "", app->o.video ? app->o.video : "");
    gsf_splat_destroy_rasterizer(ctx, rasterizer);
    close_filter(app, &filter);
    gsf_free(ctx, path);
    gsf_splat_destroy_scene(ctx, &scene);
    gsf_splat_destroy(ctx, &splats);
    return result;
}

static int run_render(gsfix_app* app) {
    const char* r = app->o.restorer;
    const int filtered = r && strcmp(r, "none") != 0;
    if (filtered && strcmp(r, "warp") != 0 && !is_mini(r))
        return gsfix_misused(app, "--restorer %s: render takes none|warp|mini[:FILE]", r);
    if (filtered && !app->o.scene) return gsfix_misused(app, "--restorer: needs the photos of a --scene");
    if (app->o.fixed_exposure && !filtered) return gsfix_misused(app, "--fixed-exposure: needs a --restorer");
    if (app->o.with && !filtered) return gsfix_misused(app, "--with: needs a --restorer");
    if (!filtered && !app->o.scene == !app->o.path) return gsfix_misused(app, "one of --scene and --path is needed");
    if (app->o.depth_as && !depth_is_exr(app) && !depth_is_png(app))
        return gsfix_misused(app, "--depth-as %s: one of exr and png16", app->o.depth_as);
    if (app->o.depth_as && !app->o.depth) return gsfix_misused(app, "--depth-as: only with --depth");
    float background[3];
    int code = gsfix_splats_background(app, background);
    if (code == 0) code = gsfix_check_video(app);
    if (code) return code;
    return render_all(app, app->o.background ? background : NULL) == GSF_OK ? 0 : gsfix_failed(app);
}

// ---- filter ----------------------------------------------------------------------

static gsf_result filter_scene(gsfix_app* app) {
    gsf_context* ctx = &app->ctx;
    gsf_scene scene;
    gsfix_split split = {0};
    gsf_visibility_stats stats = {0};
    gsf_visibility_desc desc = {0};
    static const char* const files[3] = {"cameras", "images", "points3D"}; // as gsf_splat_save_colmap calls them
    const char* method = app->o.method ? app->o.method : "both";
    desc.method = strcmp(method, "embree") == 0   ? GSF_VISIBILITY_RAYS
                  : strcmp(method, "tracks") == 0 ? GSF_VISIBILITY_TRACKS
                                                  : GSF_VISIBILITY_BOTH;
    gsf_result result = gsfix_load_scene(app, app->o.inputs[0], &scene);
    if (result != GSF_OK) return result;
    uint8_t* keep = (uint8_t*)gsf_alloc_zeroed(ctx, scene.point_count + 1, 1);
    const double begin = gsfix_now();
    if (!keep) result = GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK && scene.point_count == 0)
        result = gsf_fail(ctx, GSF_ERROR_DEGENERATE, "%s: the scene has no points", app->o.inputs[0]);
    if (result == GSF_OK) result = gsfix_split_scene(app, &scene, &split);
    for (int k = 0; k < 3 && result == GSF_OK; k++) result = gsfix_claim(app, "sparse/0/%s.bin", files[k]);
    if (result == GSF_OK) result = gsfix_open_out(app);
    if (result == GSF_OK)
        result = gsf_splat_filter_points(ctx, &scene, split.train, split.train_count, &desc, keep, &stats);
    const double seconds = gsfix_now() - begin;
    if (result == GSF_OK) result = gsf_splat_save_colmap(ctx, &scene, keep, app->o.out);
    if (result == GSF_OK) {
        const char* rays = desc.method == GSF_VISIBILITY_TRACKS ? "none" : stats.used_embree ? "embree" : "z-buffer";
        gsfix_json_text(ctx, &app->json, "method", method);
        gsfix_json_text(ctx, &app->json, "rays_by", rays);
        gsfix_json_number(ctx, &app->json, "points", (double)stats.points);
        gsfix_json_number(ctx, &app->json, "kept", (double)stats.kept);
        gsfix_json_number(ctx, &app->json, "by_tracks", (double)stats.by_tracks);
        gsfix_json_number(ctx, &app->json, "by_rays", (double)stats.by_rays);
        gsfix_json_number(ctx, &app->json, "rays", (double)stats.rays);
        gsfix_json_number(ctx, &app->json, "seconds", seconds);
        gsfix_print(app, "%zu of %zu points kept for %zu views: %zu by track, %zu more by ray (%s), %.2f s", stats.kept,
                    stats.points, split.train_count, stats.by_tracks, stats.by_rays, rays, seconds);
        gsfix_print(app, "%s/sparse/0 written; the photos stay in %s", app->o.out, app->o.inputs[0]);
    }
    gsf_free(ctx, keep);
    gsfix_free_split(app, &split);
    gsf_splat_destroy_scene(ctx, &scene);
    return result;
}

static int run_filter(gsfix_app* app) { return filter_scene(app) == GSF_OK ? 0 : gsfix_failed(app); }

// ---- convert ---------------------------------------------------------------------

static gsf_result convert_splats(gsfix_app* app) {
    gsf_context* ctx = &app->ctx;
    gsf_splat_save_desc desc = {0};
    gsf_splats splats;
    desc.spz_version = app->o.spz_version;
    gsf_result result = gsf_splat_load(ctx, app->o.inputs[0], &splats);
    if (result != GSF_OK) return result;
    result = gsfix_claim_file(app, app->o.out);
    if (result == GSF_OK) result = gsf_splat_save(ctx, app->o.out, &splats, &desc);
    if (result == GSF_OK) {
        gsfix_json_number(ctx, &app->json, "splats", (double)splats.count);
        gsfix_json_number(ctx, &app->json, "sh_degree", splats.sh_degree);
        gsfix_print(app, "%zu splats of SH degree %d -> %s", splats.count, (int)splats.sh_degree, app->o.out);
    }
    gsf_splat_destroy(ctx, &splats);
    return result;
}

static int run_convert(gsfix_app* app) { return convert_splats(app) == GSF_OK ? 0 : gsfix_failed(app); }

// ---- path ------------------------------------------------------------------------

static gsf_result write_path(gsfix_app* app, int frames, int windows) {
    gsf_context* ctx = &app->ctx;
    gsf_scene scene;
    gsfix_split split = {0};
    gsf_camera *cameras = NULL, *path = NULL;
    int32_t* reference = NULL;
    const char** names = NULL;
    void* scratch = NULL;
    gsf_traj_path_desc desc = {0};
    gsf_traj_path_info layout = {0};
    gsf_result result = gsfix_load_scene(app, app->o.inputs[0], &scene);
    if (result != GSF_OK) return result;
    const char* file = strrchr(app->o.out, '/') ? strrchr(app->o.out, '/') + 1 : app->o.out;
    const int colmap = strcmp(file, "images.txt") == 0, others = colmap || strcmp(file, "transforms.json") == 0;
    const int folder = (int)(file - app->o.out);
    result = gsfix_claim_file(app, app->o.out);
    if (result == GSF_OK && colmap) result = gsfix_claim_file(app, gsfix_pathf("%.*scameras.txt", folder, app->o.out).s);
    if (result == GSF_OK && colmap) result = gsfix_claim_file(app, gsfix_pathf("%.*spoints3D.txt", folder, app->o.out).s);
    if (result == GSF_OK) result = gsfix_split_scene(app, &scene, &split);
    if (result == GSF_OK) result = gsfix_camera_list(app, &scene, split.train, split.train_count, &cameras);
    desc.kind = gsfix_path_kind(app->o.kind);
    desc.window_length = frames / windows;
    desc.window_count = windows;
    desc.seed = app->o.seed;
    desc.points = scene.points;
    desc.point_count = scene.point_count;
    if (result == GSF_OK) result = gsf_traj_query_path(ctx, split.train_count, &desc, &layout);
    if (result == GSF_OK) {
        path = (gsf_camera*)gsf_alloc(ctx, layout.frame_count + 1, sizeof *path);
        reference = (int32_t*)gsf_alloc(ctx, layout.frame_count + 1, sizeof *reference);
        names = (const char**)gsf_alloc_zeroed(ctx, layout.frame_count + 1, sizeof *names);
        scratch = gsf_alloc(ctx, layout.scratch_bytes + 1, 1);
        result = path && reference && names && scratch ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    }
    if (result == GSF_OK) result = gsf_traj_sample_path(ctx, cameras, split.train_count, &desc, scratch, path, reference);
    size_t photos = 0;
    for (size_t i = 0; i < layout.frame_count && result == GSF_OK; i++)
        if (reference[i] >= 0) {
            names[i] = scene.views[split.train[reference[i]]].name;
            photos++;
        }
    // In other programs' formats the names are those of `gsfix render --path`.
    if (result == GSF_OK) result = gsf_save_cameras(ctx, app->o.out, path, others ? NULL : names, layout.frame_count);
    if (result == GSF_OK) {
        gsfix_json_text(ctx, &app->json, "kind", app->o.kind ? app->o.kind : "reference");
        gsfix_json_number(ctx, &app->json, "frames", (double)layout.frame_count);
        gsfix_json_number(ctx, &app->json, "windows", layout.window_count);
        gsfix_json_number(ctx, &app->json, "photos", (double)photos);
        gsfix_print(app, "%zu cameras (%zu of them at a photo) in %d windows -> %s", layout.frame_count, photos,
                    (int)layout.window_count, app->o.out);
    }
    gsf_free(ctx, scratch);
    gsf_free(ctx, (void*)names);
    gsf_free(ctx, reference);
    gsf_free(ctx, path);
    gsf_free(ctx, cameras);
    gsfix_free_split(app, &split);
    gsf_splat_destroy_scene(ctx, &scene);
    return result;
}

static int run_path(gsfix_app* app) {
    const int frames = app->o.frames ? app->o.frames : 120, windows = app->o.windows ? app->o.windows : 1;
    if (frames % windows != 0 || frames / windows < 2)
        return gsfix_misused(app, "--frames %d cannot be divided into %d windows of two or more frames", frames, windows);
    return write_path(app, frames, windows) == GSF_OK ? 0 : gsfix_failed(app);
}

// ---- metrics ---------------------------------------------------------------------

typedef struct metric_spec {
    const char* name;
    int net;      // a gsf_nn_metric_kind, or PIXELS of a gsf_metric
    int raw, clip; // for LPIPS; measures DIR_A as a clip, CLIP_ALONE: without DIR_B
} metric_spec;

enum { CLIP_ALONE = 2 };
#define PIXELS(metric) (-1 - (int)GSF_METRIC_##metric) // and back: (gsf_metric)(-1 - net)
static const metric_spec metric_specs[] = {
    {"psnr", PIXELS(PSNR), 0, 0},
    {"ssim_3dgs", PIXELS(SSIM_3DGS), 0, 0},
    {"ssim_torchmetrics", PIXELS(SSIM_TORCHMETRICS), 0, 0},
    {"ssim_skimage", PIXELS(SSIM_SKIMAGE), 0, 0},
    {"ms_ssim", PIXELS(MS_SSIM), 0, 0},
    {"ms_ssim_torchmetrics", PIXELS(MS_SSIM_TORCHMETRICS), 0, 0},
    {"lpips_alex", GSF_NN_METRIC_LPIPS_ALEX, 0, 0},
    {"lpips_vgg", GSF_NN_METRIC_LPIPS_VGG, 0, 0},
    {"lpips_squeeze", GSF_NN_METRIC_LPIPS_SQUEEZE, 0, 0},
    {"lpips_alex_raw", GSF_NN_METRIC_LPIPS_ALEX, 1, 0},
    {"lpips_vgg_raw", GSF_NN_METRIC_LPIPS_VGG, 1, 0},
    {"lpips_squeeze_raw", GSF_NN_METRIC_LPIPS_SQUEEZE, 1, 0},
    {"i2v_subject", GSF_NN_METRIC_I2V_SUBJECT, 0, 1},
    {"i2v_background", GSF_NN_METRIC_I2V_BACKGROUND, 0, 1},
    {"motion_smoothness", GSF_NN_METRIC_MOTION_SMOOTHNESS, 0, CLIP_ALONE},
    {"overall_consistency", GSF_NN_METRIC_OVERALL_CONSISTENCY, 0, CLIP_ALONE},
    {"temporal_flickering", PIXELS(DIFFERENCE), 0, CLIP_ALONE},
};
enum { METRIC_COUNT = sizeof metric_specs / sizeof *metric_specs };

typedef struct metric_run {
    int wanted[METRIC_COUNT];
    gsf_nn_metric nets[METRIC_COUNT]; // of the metrics that need a network
} metric_run;

// Of a pair of images. Masks apply to the metrics of pixels that have one scale.
static int measures_pair(const metric_run* run, int m, int seen) {
    const int net = metric_specs[m].net, masked = net < 0 && net >= PIXELS(SSIM_SKIMAGE);
    return run->wanted[m] && !metric_specs[m].clip && (!seen || masked);
}

static gsf_result measure(gsf_context* ctx, metric_run* run, int m, const gsf_image* a, const gsf_image* b,
                          const gsf_image* mask, double* out) {
    const int net = metric_specs[m].net;
    if (net < 0) return gsf_measure_image(ctx, (gsf_metric)(-1 - net), a, b, mask, out);
    const gsf_result result = gsf_nn_measure_frame(ctx, &run->nets[m], a, b);
    *out = run->nets[m].last;
    return result;
}

// Opens the networks of the wanted metrics, so that a missing file is reported before any work.
static gsf_result open_networks(gsfix_app* app, metric_run* run, const char* prompt) {
    gsf_result result = GSF_OK;
    for (int m = 0; m < METRIC_COUNT && result == GSF_OK; m++) {
        if (!run->wanted[m] || metric_specs[m].net < 0) continue;
        run->nets[m].kind = (gsf_nn_metric_kind)metric_specs[m].net;
        run->nets[m].raw = metric_specs[m].raw;
        run->nets[m].models = app->o.models;
        run->nets[m].prompt = prompt;
        result = gsf_nn_measure_frame(&app->ctx, &run->nets[m], NULL, NULL);
    }
    return result;
}

typedef struct metric_sums { // [0]: over all pixels, [1]: over those of the masks
    double sums[2][METRIC_COUNT];
    size_t pairs[2];
} metric_sums;

static const char* metric_name(int metric, int seen, gsfix_path* name) {
    *name = gsfix_pathf("%s%s", metric_specs[metric].name, seen ? "_seen" : "");
    return name->s;
}

// The image's mask, if the folder given with --masks has one with at least one white pixel; else data is NULL.
static gsf_result load_pair_mask(gsfix_app* app, const char* stem, gsf_image* mask) {
    const gsfix_path path = gsfix_pathf("%s/%s.png", app->o.masks ? app->o.masks : "", stem);
    if (!app->o.masks || !gsfix_exists(path.s)) return GSF_OK;
    const gsf_result result = gsf_load_image(&app->ctx, path.s, 1, mask);
    if (result == GSF_OK && !gsfix_counts_any(mask)) gsf_destroy_image(&app->ctx, mask);
    return result;
}

static gsf_result compare_pair(gsfix_app* app, metric_run* run, const char* stem, const char* left, const char* right,
                               metric_sums* total) {
    gsf_context* ctx = &app->ctx;
    gsf_image x = {0}, y = {0}, mask = {0};
    char line[384] = "";
    gsf_result result = gsf_load_image(ctx, left, 3, &x);
    if (result == GSF_OK) result = gsf_load_image(ctx, right, 3, &y);
    if (result == GSF_OK && (x.width != y.width || x.height != y.height))
        result = gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: %lld x %lld in %s, %lld x %lld in %s", stem,
                          (long long)x.width, (long long)x.height, app->o.inputs[0], (long long)y.width,
                          (long long)y.height, app->o.inputs[1]);
    if (result == GSF_OK) result = load_pair_mask(app, stem, &mask);
    if (result == GSF_OK) {
        gsfix_json_begin(ctx, &app->json, NULL, '{');
        gsfix_json_text(ctx, &app->json, "name", stem);
    }
    for (int seen = 0; seen <= (mask.data != NULL) && result == GSF_OK; seen++) {
        for (int m = 0; m < METRIC_COUNT && result == GSF_OK; m++) {
            double value = 0.0;
            gsfix_path name;
            if (!measures_pair(run, m, seen)) continue;
            result = measure(ctx, run, m, &x, &y, seen ? &mask : NULL, &value);
            if (result != GSF_OK) break;
            total->sums[seen][m] += value;
            gsfix_json_number(ctx, &app->json, metric_name(m, seen, &name), value);
            snprintf(line + strlen(line), sizeof line - strlen(line), m ? "  %.5f" : "  %.3f", value);
        }
        if (result == GSF_OK) total->pairs[seen]++;
    }
    if (result == GSF_OK) {
        gsfix_json_end(ctx, &app->json, '}');
        gsfix_print(app, "%-24s%s", stem, line);
    }
    gsf_destroy_image(ctx, &x);
    gsf_destroy_image(ctx, &y);
    gsf_destroy_image(ctx, &mask);
    return result;
}

static void print_means(gsfix_app* app, const metric_run* run, const metric_sums* total) {
    for (int seen = 0; seen < 2; seen++) {
        if (!total->pairs[seen]) continue;
        gsfix_print(app, "means of %zu pairs%s:", total->pairs[seen], seen ? ", where the masks are white" : "");
        for (int m = 0; m < METRIC_COUNT; m++) {
            const double mean = total->sums[seen][m] / (double)total->pairs[seen];
            gsfix_path name;
            if (!measures_pair(run, m, seen)) continue;
            gsfix_json_number(&app->ctx, &app->json, metric_name(m, seen, &name), mean);
            gsfix_print(app, "  %-22s %.5f", name.s, mean);
        }
    }
}

// Measures the frame after `before`, which has no data for the first one.
static gsf_result measure_frame(gsf_context* ctx, metric_run* run, int m, const gsf_image* before, const gsf_image* frame,
                                const gsf_image* input) {
    gsf_nn_metric* net = &run->nets[m];
    double change = 0.0;
    if (metric_specs[m].net >= 0) return gsf_nn_measure_frame(ctx, net, frame, input);
    gsf_result result = GSF_OK;
    if (before->data) result = gsf_measure_image(ctx, (gsf_metric)(-1 - metric_specs[m].net), before, frame, NULL, &change);
    net->last += change; // the sum, as there is no network
    net->score = net->count ? 1.0 - net->last / (double)net->count : 1.0;
    net->count++;
    return result;
}

static size_t least_frames(int net) {
    return net == GSF_NN_METRIC_MOTION_SMOOTHNESS ? 3 : net == GSF_NN_METRIC_OVERALL_CONSISTENCY ? 1 : 2;
}

// Passes the pictures of DIR_A, in the order of their names, to what measures clips, with DIR_B's first picture, if there is a
// DIR_B, as the input image. Two frames are held at a time.
static gsf_result measure_clip(gsfix_app* app, metric_run* run, const gsfix_names* left, const gsfix_names* right) {
    gsf_context* ctx = &app->ctx;
    int clips = 0;
    gsf_result result = GSF_OK;
    gsf_image input = {0}, frame = {0}, before = {0};
    for (int m = 0; m < METRIC_COUNT; m++) {
        if (!run->wanted[m] || !metric_specs[m].clip) continue;
        const size_t least = least_frames(metric_specs[m].net);
        run->nets[m].frames = (int64_t)left->count;
        if (left->count < least)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s has %zu pictures; %s needs at least %zu", app->o.inputs[0],
                            left->count, metric_specs[m].name, least);
        clips = 1;
    }
    if (!clips) return GSF_OK;
    if (right && !right->count) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s has no pictures", app->o.inputs[1]);
    if (right) result = gsf_load_image(ctx, gsfix_pathf("%s/%s", app->o.inputs[1], right->names[0]).s, 3, &input);
    for (size_t i = 0; i < left->count && result == GSF_OK; i++) {
        result = gsf_load_image(ctx, gsfix_pathf("%s/%s", app->o.inputs[0], left->names[i]).s, 3, &frame);
        for (int m = 0; m < METRIC_COUNT && result == GSF_OK; m++)
            if (run->wanted[m] && metric_specs[m].clip)
                result = measure_frame(ctx, run, m, &before, &frame, right ? &input : NULL);
        gsf_destroy_image(ctx, &before);
        before = frame;
        memset(&frame, 0, sizeof frame);
        gsfix_progress(app, (double)(i + 1), (double)left->count, "frame %zu of %zu", i + 1, left->count);
    }
    gsf_destroy_image(ctx, &before);
    gsf_destroy_image(ctx, &input);
    if (result != GSF_OK) return result;
    gsfix_print(app, "clip of %zu frames:", left->count);
    for (int m = 0; m < METRIC_COUNT; m++) {
        if (!run->wanted[m] || !metric_specs[m].clip) continue;
        gsfix_json_number(ctx, &app->json, metric_specs[m].name, run->nets[m].score);
        gsfix_print(app, "  %-22s %.5f", metric_specs[m].name, run->nets[m].score);
    }
    return result;
}

static gsf_result compare_folders(gsfix_app* app, metric_run* run) {
    gsf_context* ctx = &app->ctx;
    const char *a = app->o.inputs[0], *b = app->o.input_count > 1 ? app->o.inputs[1] : NULL;
    gsfix_names left = {0}, right = {0};
    metric_sums total = {0};
    int by_pair = 0;
    gsf_result result = open_networks(app, run, app->o.prompt);
    for (int m = 0; m < METRIC_COUNT; m++) by_pair |= measures_pair(run, m, 0);
    if (result == GSF_OK) result = gsfix_list(ctx, a, ".png.jpg.jpeg.bmp.tga.ppm.pgm", &left);
    if (result == GSF_OK && b) result = gsfix_list(ctx, b, ".png.jpg.jpeg.bmp.tga.ppm.pgm", &right);
    gsfix_json_begin(ctx, &app->json, "per_image", '[');
    for (size_t i = 0; i < left.count && result == GSF_OK && by_pair; i++) {
        const gsfix_path stem = gsfix_stem(left.names[i]);
        size_t k = 0;
        while (k < right.count && strcmp(gsfix_stem(right.names[k]).s, stem.s) != 0) k++;
        if (k < right.count)
            result = compare_pair(app, run, stem.s, gsfix_pathf("%s/%s", a, left.names[i]).s,
                                  gsfix_pathf("%s/%s", b, right.names[k]).s, &total);
    }
    gsfix_json_end(ctx, &app->json, ']');
    const size_t pairs = total.pairs[0], unpaired = left.count + right.count - 2 * pairs;
    if (result == GSF_OK && !pairs && by_pair)
        result = gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s and %s have no picture of the same name", a, b);
    if (result == GSF_OK && by_pair) {
        gsfix_json_number(ctx, &app->json, "pairs", (double)pairs);
        gsfix_json_number(ctx, &app->json, "unpaired", (double)unpaired);
        print_means(app, run, &total);
        if (unpaired) gsfix_note(app, "note: %zu pictures have no partner", unpaired);
    }
    if (result == GSF_OK) result = measure_clip(app, run, &left, b ? &right : NULL);
    for (int m = 0; m < METRIC_COUNT; m++) gsf_nn_destroy_metric(ctx, &run->nets[m]);
    gsfix_free_names(ctx, &left);
    gsfix_free_names(ctx, &right);
    return result;
}

static int run_metrics(gsfix_app* app) {
    metric_run run = {0};
    int nets = 0, prompts = 0;
    const char* which = app->o.which ? app->o.which : "psnr,ssim_3dgs";
    if (app->o.input_count > 2) return gsfix_misused(app, "metrics: two folders at most");
    for (const char* p = which;; p++) {
        const size_t n = strcspn(p, ",");
        int m = 0;
        while (m < METRIC_COUNT && !(strlen(metric_specs[m].name) == n && strncmp(metric_specs[m].name, p, n) == 0)) m++;
        if (m == METRIC_COUNT) return gsfix_misused(app, "the metric \"%.*s\" is not in this version", (int)n, p);
        if (metric_specs[m].net >= 0 && !app->o.models)
            return gsfix_misused(app, "%s needs --models", metric_specs[m].name);
        const int reads = metric_specs[m].net == GSF_NN_METRIC_OVERALL_CONSISTENCY;
        if (reads && !app->o.prompt) return gsfix_misused(app, "%s needs --prompt", metric_specs[m].name);
        if (app->o.input_count < 2 && metric_specs[m].clip != CLIP_ALONE)
            return gsfix_misused(app, "%s needs DIR_B", metric_specs[m].name);
        prompts += reads;
        run.wanted[m] = 1;
        nets += metric_specs[m].net >= 0;
        p += n;
        if (!*p) break;
    }
    if (app->o.models && !nets) return gsfix_misused(app, "--models: no metric of --which needs it");
    if (app->o.prompt && !prompts) return gsfix_misused(app, "--prompt: no metric of --which needs it");
    return compare_folders(app, &run) == GSF_OK ? 0 : gsfix_failed(app);
}

struct gsfix_meter {
    metric_run run;
    gsf_image before; // the last frame of the clip
    double sums[METRIC_COUNT];
    size_t pairs;
};

gsf_result gsfix_make_meter(gsfix_app* app, const char* which, const char* prompt, size_t frames, gsfix_meter** out) {
    *out = (gsfix_meter*)gsf_alloc_zeroed(&app->ctx, 1, sizeof **out);
    if (!*out) return GSF_ERROR_OUT_OF_MEMORY;
    for (const char* p = which; *p; p += strspn(p, ",")) {
        const size_t n = strcspn(p, ",");
        for (int m = 0; m < METRIC_COUNT; m++)
            if (strlen(metric_specs[m].name) == n && strncmp(metric_specs[m].name, p, n) == 0) (*out)->run.wanted[m] = 1;
        p += n;
    }
    for (int m = 0; m < METRIC_COUNT; m++) (*out)->run.nets[m].frames = (int64_t)frames;
    return open_networks(app, &(*out)->run, prompt);
}

gsf_result gsfix_meter_frame(gsfix_app* app, gsfix_meter* meter, const gsf_image* frame, const gsf_image* truth,
                             const gsf_image* input) {
    gsf_result result = GSF_OK;
    for (int m = 0; m < METRIC_COUNT && result == GSF_OK; m++) {
        double value = 0.0;
        if (!meter->run.wanted[m]) continue;
        if (metric_specs[m].clip && input) result = measure_frame(&app->ctx, &meter->run, m, &meter->before, frame, input);
        if (metric_specs[m].clip || !truth) continue;
        result = measure(&app->ctx, &meter->run, m, frame, truth, NULL, &value);
        meter->sums[m] += value;
    }
    if (result == GSF_OK && truth) meter->pairs++;
    if (result == GSF_OK && input) { // the frame is borrowed
        gsf_destroy_image(&app->ctx, &meter->before);
        result = gsf_make_image(&app->ctx, frame->dtype, frame->width, frame->height, frame->channels, &meter->before);
        if (result == GSF_OK) result = gsf_convert_image(&app->ctx, frame, &meter->before);
    }
    return result;
}

double gsfix_read_meter(const gsfix_meter* meter, const char* name) {
    for (int m = 0; m < METRIC_COUNT; m++) {
        if (strcmp(metric_specs[m].name, name) != 0 || !meter->run.wanted[m]) continue;
        if (metric_specs[m].clip) return meter->run.nets[m].count ? meter->run.nets[m].score : NAN;
        return meter->sums[m] / (double)meter->pairs; // of none: NaN
    }
    return NAN;
}

void gsfix_destroy_meter(gsfix_app* app, gsfix_meter* meter) {
    for (int m = 0; meter && m < METRIC_COUNT; m++) gsf_nn_destroy_metric(&app->ctx, &meter->run.nets[m]);
    if (meter) gsf_destroy_image(&app->ctx, &meter->before);
    gsf_free(&app->ctx, meter);
}

// ---- masks -----------------------------------------------------------------------

static gsf_result write_masks(gsfix_app* app) {
    gsf_context* ctx = &app->ctx;
    gsf_scene scene;
    gsf_splats splats = {0};
    gsfix_split split = {0};
    gsf_camera* train = NULL;
    double mean = 0.0;
    gsf_result result = gsfix_load_scene(app, app->o.inputs[0], &scene);
    if (result != GSF_OK) return result;
    result = gsf_splat_load(ctx, app->o.model, &splats);
    if (result == GSF_OK) result = gsfix_split_scene(app, &scene, &split);
    if (result == GSF_OK) result = gsfix_camera_list(app, &scene, split.train, split.train_count, &train);
    for (size_t i = 0; i < split.test_count && result == GSF_OK; i++)
        result = gsfix_claim(app, "%s.png", gsfix_view_stem(&scene, split.test[i]).s);
    if (result == GSF_OK) result = gsfix_open_out(app);
    if (result == GSF_OK) result = gsfix_remove_stale(app);
    gsfix_json_begin(ctx, &app->json, "per_view", '[');
    for (size_t i = 0; i < split.test_count && result == GSF_OK; i++) {
        const gsf_scene_view* view = &scene.views[split.test[i]];
        gsf_image mask = {0};
        result = gsf_make_image(ctx, GSF_U8, view->camera.width, view->camera.height, 1, &mask);
        if (result == GSF_OK) result = gsf_splat_render_seen_mask(ctx, &splats, &view->camera, train, split.train_count,
                                                                  &mask);
        if (result == GSF_OK) {
            uint8_t* p = (uint8_t*)mask.data;
            const size_t pixels = (size_t)mask.width * (size_t)mask.height;
            size_t seen = 0;
            for (size_t k = 0; k < pixels; k++) {
                seen += p[k] != 0;
                p[k] = p[k] ? 255 : 0;
            }
            const double share = (double)seen / (double)pixels;
            mean += share / (double)split.test_count;
            gsfix_json_begin(ctx, &app->json, NULL, '{');
            gsfix_json_text(ctx, &app->json, "name", view->name);
            gsfix_json_number(ctx, &app->json, "seen", share);
            gsfix_json_end(ctx, &app->json, '}');
            gsfix_print(app, "%-24s %5.1f %% seen", view->name, 100.0 * share);
            result = gsf_save_image(
                ctx, gsfix_pathf("%s/%s.png", app->o.out, gsfix_view_stem(&scene, split.test[i]).s).s, &mask);
        }
        gsf_destroy_image(ctx, &mask);
        gsfix_progress(app, (double)(i + 1), (double)split.test_count, "mask %zu of %zu", i + 1, split.test_count);
    }
    gsfix_json_end(ctx, &app->json, ']');
    gsfix_json_number(ctx, &app->json, "seen", mean);
    if (result == GSF_OK)
        gsfix_print(app, "%.1f %% of the held-out pixels are seen from %zu views", 100.0 * mean, split.train_count);
    gsf_free(ctx, train);
    gsfix_free_split(app, &split);
    gsf_splat_destroy(ctx, &splats);
    gsf_splat_destroy_scene(ctx, &scene);
    return result;
}

static int run_masks(gsfix_app* app) {
    if (!app->o.model) return gsfix_misused(app, "--model is missing");
    return write_masks(app) == GSF_OK ? 0 : gsfix_failed(app);
}

// ---- restore ---------------------------------------------------------------------

/* One clip. FRAMES_DIR is a folder of images, or has the layout of a restorer's job:
       frames/NAME.png  depth/NAME.npy  cameras.json
       refs/NAME.png  refs/cameras.json  refs/depth/NAME.npy  refs/render/NAME.png
   exec needs only the frames; warp needs all of it (without refs/render it reprojects the photos themselves). */
gsf_result gsfix_load_float(gsf_context* ctx, const char* path, int32_t channels, gsf_image* out) {
    gsf_image bytes;
    memset(out, 0, sizeof *out);
    gsf_result result = gsf_load_image(ctx, path, channels, &bytes);
    if (result != GSF_OK) return result;
    result = gsf_make_image(ctx, GSF_F32, bytes.width, bytes.height, channels, out);
    if (result == GSF_OK) result = gsf_convert_image(ctx, &bytes, out);
    gsf_destroy_image(ctx, &bytes);
    return result;
}

gsf_result gsfix_make_clip(gsf_context* ctx, size_t frames, gsfix_clip* c) {
    c->color = (gsf_image*)gsf_alloc_zeroed(ctx, 5 * frames, sizeof *c->color);
    c->reference_index = (int32_t*)gsf_alloc(ctx, frames, sizeof *c->reference_index);
    if (!c->color || !c->reference_index) return GSF_ERROR_OUT_OF_MEMORY;
    c->frames = frames;
    c->depth = c->color + frames;
    c->alpha = c->depth + frames;
    c->out_color = c->alpha + frames;
    c->out_confidence = c->out_color + frames;
    for (size_t i = 0; i < frames; i++) c->reference_index[i] = -1;
    return GSF_OK;
}

static gsf_result load_clip_frames(gsfix_app* app, gsfix_clip* c) {
    gsf_context* ctx = &app->ctx;
    const char* folder = app->o.inputs[0];
    const gsfix_path inner = gsfix_pathf("%s/frames", folder);
    const char* at = gsfix_is_folder(inner.s) ? inner.s : folder;
    const int depth = gsfix_is_folder(gsfix_pathf("%s/depth", folder).s);
    const int alpha = gsfix_is_folder(gsfix_pathf("%s/alpha", folder).s);
    gsf_result result = gsfix_list(ctx, at, ".png.jpg.jpeg", &c->frame_names);
    if (result != GSF_OK) return result;
    const size_t n = c->frame_names.count;
    if (n == 0) return gsf_fail(ctx, GSF_ERROR_IO, "%s: no pictures there", at);
    if ((result = gsfix_make_clip(ctx, n, c)) != GSF_OK) return result;
    for (size_t i = 0; i < n && result == GSF_OK; i++) {
        const gsfix_path stem = gsfix_stem(c->frame_names.names[i]);
        for (size_t k = 0; k < i; k++) // a.jpg and a.png would share one output name
            if (strcmp(gsfix_stem(c->frame_names.names[k]).s, stem.s) == 0)
                return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: %s and %s differ in nothing but their ending", at,
                                c->frame_names.names[k], c->frame_names.names[i]);
        result = gsfix_load_float(ctx, gsfix_pathf("%s/%s", at, c->frame_names.names[i]).s, 3, c->color + i);
        const int64_t width = c->color[i].width, height = c->color[i].height;
        if (result == GSF_OK && (width != c->color[0].width || height != c->color[0].height))
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s/%s: %lld x %lld, but the first frame is %lld x %lld", at,
                            c->frame_names.names[i], (long long)width, (long long)height, (long long)c->color[0].width,
                            (long long)c->color[0].height);
        if (result == GSF_OK && depth)
            result = gsfix_load_npy(ctx, gsfix_pathf("%s/depth/%s.npy", folder, stem.s).s, c->depth + i);
        if (result == GSF_OK && depth && (c->depth[i].width != width || c->depth[i].height != height))
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s/depth/%s.npy: not of the frame's size", folder, stem.s);
        if (result == GSF_OK && alpha)
            result = gsfix_load_float(ctx, gsfix_pathf("%s/alpha/%s.png", folder, stem.s).s, 1, c->alpha + i);
        if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, width, height, 3, c->out_color + i);
        if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, width, height, 1, c->out_confidence + i);
    }
    if (!depth) c->depth = NULL;
    if (!alpha) c->alpha = NULL;
    const gsfix_path cameras = gsfix_pathf("%s/cameras.json", folder);
    if (result == GSF_OK && gsfix_exists(cameras.s)) {
        result = gsf_load_cameras(ctx, cameras.s, &c->cameras, &c->camera_count);
        if (result == GSF_OK && c->camera_count != n)
            result = gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: %zu cameras for %zu frames", cameras.s,
                              c->camera_count, n);
    }
    return result;
}

static gsf_result load_clip_refs(gsfix_app* app, gsfix_clip* c) {
    gsf_context* ctx = &app->ctx;
    const gsfix_path folder = gsfix_pathf("%s/refs", app->o.inputs[0]);
    gsf_result result = GSF_OK;
    if (app->o.refs) {
        size_t count = 1;
        for (const char* p = app->o.refs; *p; p++) count += *p == ',';
        c->ref_names.names = (char**)gsf_alloc_zeroed(ctx, count, sizeof(char*));
        if (!c->ref_names.names) return GSF_ERROR_OUT_OF_MEMORY;
        for (const char* p = app->o.refs; c->ref_names.count < count; p += strcspn(p, ",") + 1)
            if (!(c->ref_names.names[c->ref_names.count++] = gsfix_copy_text(ctx, p, strcspn(p, ","))))
                return GSF_ERROR_OUT_OF_MEMORY;
    } else if (gsfix_is_folder(folder.s)) {
        result = gsfix_list(ctx, folder.s, ".png.jpg.jpeg", &c->ref_names);
    }
    const gsfix_path cameras = gsfix_pathf("%s/cameras.json", folder.s);
    if (result == GSF_OK && gsfix_exists(cameras.s))
        result = gsf_load_cameras(ctx, cameras.s, &c->ref_cameras, &c->ref_camera_count);
    if (result != GSF_OK) return result;
    c->references = (gsf_reference*)gsf_alloc_zeroed(ctx, c->ref_names.count + 1, sizeof *c->references);
    if (!c->references) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < c->ref_names.count && result == GSF_OK; i++) {
        gsf_reference* r = c->references + i;
        const char* name = c->ref_names.names[i];
        c->refs = i + 1;
        result = gsfix_load_float(ctx, app->o.refs ? name : gsfix_pathf("%s/%s", folder.s, name).s, 3, &r->color);
        if (result == GSF_OK && c->ref_camera_count == c->ref_names.count) r->camera = c->ref_cameras[i];
        const gsfix_path render = gsfix_pathf("%s/render/%s.png", folder.s, gsfix_stem(name).s);
        const gsfix_path depth = gsfix_pathf("%s/depth/%s.npy", folder.s, gsfix_stem(name).s);
        if (result == GSF_OK && gsfix_exists(render.s)) result = gsfix_load_float(ctx, render.s, 3, &r->render);
        if (result == GSF_OK && gsfix_exists(depth.s)) result = gsfix_load_npy(ctx, depth.s, &r->depth);
    }
    return result;
}

static gsf_result check_warp_clip(gsfix_app* app, const gsfix_clip* c) { // requirements of the warp restorer
    const char* folder = app->o.inputs[0];
    const char* lacks = !c->cameras                       ? "cameras.json (where the frames are)"
                        : !c->depth                       ? "depth/NAME.npy of each frame"
                        : !c->refs                        ? "refs/ (the photos)"
                        : c->ref_camera_count != c->refs  ? "refs/cameras.json with a camera for each photo"
                                                          : NULL;
    for (size_t i = 0; !lacks && i < c->refs; i++)
        if (!c->references[i].depth.data) lacks = "refs/depth/NAME.npy of each photo";
    if (!lacks) return GSF_OK;
    return gsf_fail(&app->ctx, GSF_ERROR_IO, "%s: the restorer warp needs %s", folder, lacks);
}

gsf_result gsfix_restore_clip(gsfix_app* app, gsfix_clip* c, gsf_restorer* restorer) {
    gsf_context* ctx = &app->ctx;
    gsf_restore_window window = {0};
    window.struct_size = sizeof window;
    window.frame_count = (int32_t)c->frames;
    window.color = c->color;
    window.depth = c->depth;
    window.alpha = c->alpha;
    window.cameras = c->cameras;
    window.reference_index = c->reference_index;
    window.seed = app->o.seed;
    window.out_color = c->out_color;
    window.out_confidence = c->out_confidence;
    gsf_result result = restorer->begin_fn(restorer->user, ctx, c->references, (int32_t)c->refs);
    if (result != GSF_OK) return result;
    result = gsf_restore_clip(ctx, restorer, &window);
    restorer->end_fn(restorer->user, ctx);
    return result;
}

void gsfix_free_clip(gsfix_app* app, gsfix_clip* c) {
    gsf_context* ctx = &app->ctx;
    for (size_t i = 0; i < 5 * c->frames; i++) gsf_destroy_image(ctx, c->color + i);
    for (size_t i = 0; i < c->refs; i++) {
        gsf_destroy_image(ctx, &c->references[i].color);
        gsf_destroy_image(ctx, &c->references[i].render);
        gsf_destroy_image(ctx, &c->references[i].depth);
    }
    gsf_free(ctx, c->color);
    gsf_free(ctx, c->references);
    gsf_free(ctx, c->reference_index);
    gsf_free(ctx, c->cameras);
    gsf_free(ctx, c->ref_cameras);
    gsfix_free_names(ctx, &c->frame_names);
    gsfix_free_names(ctx, &c->ref_names);
}

static gsf_result open_restore_out(gsfix_app* app, const gsfix_clip* c) {
    gsf_result result = gsfix_claim(app, "dit.checkpoint");
    if (result == GSF_OK) result = gsfix_claim(app, "dit.checkpoint.*");
    for (size_t i = 0; i < c->frames && result == GSF_OK; i++) {
        const gsfix_path name = gsfix_stem(c->frame_names.names[i]);
        result = gsfix_claim(app, "%s.png", name.s);
        if (result == GSF_OK) result = gsfix_claim(app, "confidence/%s.png", name.s);
    }
    if (result == GSF_OK) result = gsfix_open_out(app);
    if (result == GSF_OK) result = gsfix_claim_file(app, app->o.save_features);
    if (result == GSF_OK) result = gsfix_claim_file(app, app->o.video);
    return result == GSF_OK ? gsfix_remove_stale(app) : result;
}

static gsf_result save_clip_video(gsfix_app* app, const gsf_image* frames, size_t count) {
    gsfix_video* video = NULL;
    gsf_result result = gsfix_begin_video(app, frames[0].width, frames[0].height, count, &video);
    for (size_t i = 0; i < count && result == GSF_OK; i++) result = gsfix_add_frame(video, frames + i);
    if (result == GSF_OK) result = gsfix_finish_video(video);
    gsfix_destroy_video(video);
    return result;
}

static gsf_result restore_folder(gsfix_app* app) {
    gsf_context* ctx = &app->ctx;
    gsfix_clip c = {0};
    gsf_restorer restorer = {0};
    int present = 0;
    const double begin = gsfix_now();
    gsf_result result = load_clip_frames(app, &c);
    if (result == GSF_OK) result = load_clip_refs(app, &c);
    if (result == GSF_OK && strcmp(app->o.restorer, "warp") == 0) result = check_warp_clip(app, &c);
    if (result == GSF_OK) result = open_restore_out(app, &c);
    if (result == GSF_OK) result = gsfix_make_restorer(app, &restorer, &present);
    if (result == GSF_OK && present) result = gsfix_restore_clip(app, &c, &restorer);
    for (size_t i = 0; i < c.frames && result == GSF_OK; i++) {
        const gsfix_path name = gsfix_stem(c.frame_names.names[i]);
        result = gsf_save_image(ctx, gsfix_pathf("%s/%s.png", app->o.out, name.s).s,
                                present ? c.out_color + i : c.color + i);
        if (result == GSF_OK && present)
            result = gsf_save_image(ctx, gsfix_pathf("%s/confidence/%s.png", app->o.out, name.s).s, c.out_confidence + i);
    }
    if (result == GSF_OK) result = save_clip_video(app, present ? c.out_color : c.color, c.frames);
    if (result == GSF_OK) result = gsfix_drop_dit_checkpoint(app);
    if (result == GSF_OK) {
        gsfix_json_text(ctx, &app->json, "restorer", app->o.restorer);
        gsfix_json_number(ctx, &app->json, "frames", (double)c.frames);
        gsfix_json_number(ctx, &app->json, "references", (double)c.refs);
        gsfix_json_number(ctx, &app->json, "seconds", gsfix_now() - begin);
        if (app->o.video) gsfix_json_text(ctx, &app->json, "video", app->o.video);
        gsfix_json_stages(app, &app->json);
        gsfix_print(app, "%zu frames restored by %s from %zu photos in %.2f s -> %s", c.frames, app->o.restorer, c.refs,
                    gsfix_now() - begin, app->o.out);
        gsfix_print_stages(app);
    }
    gsf_destroy_restorer(&app->ctx, &restorer);
    gsfix_free_clip(app, &c);
    return result;
}

static int run_restore(gsfix_app* app) {
    if (!app->o.restorer) return gsfix_misused(app, "--restorer is missing");
    int code = gsfix_check_restorer(app);
    if (code == 0) code = gsfix_check_video(app);
    if (code) return code;
    return restore_folder(app) == GSF_OK ? 0 : gsfix_failed(app);
}

// ---- main ------------------------------------------------------------------------

static gsf_context* volatile interrupted_context; // global because a signal handler takes no argument

static void on_interrupt(int number) {
    (void)number;
    if (interrupted_context) gsf_request_cancel(interrupted_context);
}

static void on_log(void* user, gsf_log_level level, const char* text) {
    if (level == GSF_LOG_WARNING) gsfix_note((gsfix_app*)user, "warning: %s", text); // errors are printed once, at the end
}

static gsf_result quote_command(gsfix_app* app, int argc, char** argv) {
    gsf_buffer text = {0};
    for (int i = 0; i < argc; i++) {
        if (i) gsf_append_bytes(&app->ctx, &text, " ", 1);
        const char* p = argv[i];
        if (*p && strspn(p, "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-+=./,:@%") == strlen(p)) {
            gsf_append_bytes(&app->ctx, &text, p, strlen(p));
            continue;
        }
        gsf_append_bytes(&app->ctx, &text, "'", 1);
        for (; *p; p++) gsf_append_bytes(&app->ctx, &text, *p == '\'' ? "'\\''" : p, *p == '\'' ? 4 : 1);
        gsf_append_bytes(&app->ctx, &text, "'", 1);
    }
    app->command_line = text.data;
    if (!text.failed) return GSF_OK;
    return GSF_ERROR_OUT_OF_MEMORY;
}

static void catch_interrupts(gsfix_app* app) { // the first signal requests a stop, the second one terminates the program
#ifdef _WIN32 // where the default action comes back by itself
    interrupted_context = &app->ctx;
    signal(SIGINT, on_interrupt);
    signal(SIGTERM, on_interrupt);
    signal(SIGBREAK, on_interrupt);
#else
    struct sigaction action;
    memset(&action, 0, sizeof action);
    action.sa_handler = on_interrupt;
    action.sa_flags = (int)SA_RESETHAND;
    sigemptyset(&action.sa_mask);
    interrupted_context = &app->ctx;
    sigaction(SIGINT, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
#ifdef SIGXFSZ
    signal(SIGXFSZ, SIG_IGN); // exceeding the file size limit then fails the write, like a full disk
#endif
#endif
}

static int run_command(gsfix_app* app, const command_spec* command, int argc, char** argv) {
    app->ctx.threads = app->o.threads;
    app->ctx.logger.log_fn = on_log;
    app->ctx.logger.user = app;
    if (gsf_init_context(&app->ctx) != GSF_OK || quote_command(app, argc, argv) != GSF_OK ||
        gsfix_begin_files(app) != GSF_OK)
        return gsfix_failed(app);
    catch_interrupts(app);
    gsfix_json_begin(&app->ctx, &app->json, NULL, '{');
    int code = command->run(app);
    gsfix_hide_bar(app);
    if (code == 0) gsfix_json_end(&app->ctx, &app->json, '}');
    if (app->json.failed && code == 0) code = gsfix_failed(app);
    if (app->o.json && code != 2) puts(app->json.data ? app->json.data : "{}");
    if (fflush(stdout) != 0 && code == 0) {
        fprintf(stderr, "gsfix %s: stdout cannot be written: %s\n", app->command, strerror(errno));
        code = 1;
    }
    interrupted_context = NULL;
    gsfix_end_files(app);
    gsf_destroy_buffer(&app->ctx, &app->json);
    gsf_free(&app->ctx, app->command_line);
    return code;
}

int gsfix_start(int argc, char** argv, const struct gsfix_crew* crew) {
    static gsfix_app app;
    memset(&app, 0, sizeof app); // tests call this more than once
    if (argc < 2) return print_overview(stderr);
    if (strcmp(argv[1], "--help") == 0 || strcmp(argv[1], "-h") == 0 || strcmp(argv[1], "help") == 0)
        return print_overview(stdout);
    if (strcmp(argv[1], "--version") == 0) return print_version(), 0;
    const command_spec* command = NULL;
    for (int i = 0; i < COMMAND_COUNT; i++)
        if (strcmp(command_specs[i].name, argv[1]) == 0) command = &command_specs[i];
    if (!command) return gsfix_misused(&app, "no command \"%s\"", argv[1]);
    if (!command->run) return gsfix_misused(&app, "the command %s is not in this version", argv[1]);
    app.command = command->name;
    app.started = gsfix_now();
#ifdef _WIN32
    app.terminal = gsfix_w_is_terminal();
#else
    app.terminal = isatty(2) && getenv("TERM") && strcmp(getenv("TERM"), "dumb") != 0;
#endif
    app.line_share = -1;
    app.crew = crew;
    app.o.inputs = (const char**)calloc((size_t)argc, sizeof(char*));
    if (!app.o.inputs) return fputs("gsfix: out of memory\n", stderr), 1;
    int code = parse_options(&app, command, argc, argv);
    if (code == 0 && app.o.help) print_help(command);
    else if (code == 0) code = run_command(&app, command, argc, argv);
    free((void*)app.o.inputs);
    return code;
}

int main(int argc, char** argv) {
#if defined(_WIN32) && !defined(main) // the system passes them in a code page that has not all letters
    char** utf8 = gsfix_w_arguments(&argc);
    if (!utf8) return fputs("gsfix: out of memory\n", stderr), 1;
    argv = utf8;
#endif
    return gsfix_start(argc, argv, NULL);
}

#ifdef GSFIX_ONE_FILE // one compiler call for the whole program
#include "gsfix_windows.c" // before those that rename its functions
#include "gsfix_dataset.c"
#include "gsfix_evaluate.c"
#include "gsfix_exec.c"
#include "gsfix_fix.c"
#include "gsfix_gallery.c"
#include "gsfix_out.c"
#include "gsfix_process.c"
#include "gsfix_report.c"
#include "gsfix_tables.c"
#include "gsfix_tasks.c"
#include "gsfix_util.c"
#include "gsfix_video.c"
#include "gsfix_view.c"
#endif
