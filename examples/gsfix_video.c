// gsfix_video.c - frames as a video: by ffmpeg, as an animated PNG, or as a page that plays them
// SPDX-License-Identifier: MIT
#include "gsfix.h"

#include <ctype.h>

/* ffmpeg (.mp4, .webm) takes the frames from a pipe and writes OUT/.gsfix/draft; an MP4 file is completed at its beginning, so
   that it cannot go through a pipe as well. The other two are built in memory. In each case the file appears whole or not at
   all. A frame of odd width or height gets one more column or row for ffmpeg, since most players want chroma at half size. */

typedef enum video_kind { VIDEO_MP4, VIDEO_WEBM, VIDEO_PNG, VIDEO_HTML, VIDEO_KINDS } video_kind;

static const char* const video_endings[VIDEO_KINDS] = {".mp4", ".webm", ".png", ".html"};

enum { VIDEO_FPS = 24, VIDEO_SIDE = 1280, VIDEO_STALL = 600 }; // longer side in a page: pixels; seconds

struct gsfix_video {
    gsfix_app* app;
    video_kind kind;
    int fps;
    size_t frames, added;
    gsf_image canvas;  // u8
    gsf_buffer png;
    uint32_t sequence; // of the next chunk of the animation
    gsfix_page page;
    gsfix_path name;   // how messages of ffmpeg begin
    gsfix_process ffmpeg;
};

static int find_kind(const char* path, video_kind* kind) {
    const char* slash = strrchr(path, '/');
    const char* dot = strrchr(slash ? slash : path, '.');
    char ending[8] = "";
    for (size_t i = 0; dot && dot[i] && i + 1 < sizeof ending; i++) ending[i] = (char)tolower((unsigned char)dot[i]);
    for (int i = 0; i < VIDEO_KINDS; i++)
        if (dot && strlen(dot) < sizeof ending && strcmp(ending, video_endings[i]) == 0) return *kind = (video_kind)i, 1;
    return 0;
}

int gsfix_check_video(gsfix_app* app) {
    const char* path = app->o.video;
    video_kind kind;
    gsfix_path ffmpeg;
    if (!path) return app->o.fps ? gsfix_misused(app, "--fps: only with --video") : 0;
    if (!find_kind(path, &kind)) return gsfix_misused(app, "--video %s: one of .mp4, .webm, .png and .html", path);
    if (kind > VIDEO_WEBM || gsfix_find_program("ffmpeg", &ffmpeg)) return 0;
    const gsf_result result = gsf_fail(&app->ctx, GSF_ERROR_UNSUPPORTED,
                                       "--video %s: needs ffmpeg, which is not in PATH (.png and .html do without)", path);
    return result == GSF_OK ? 0 : gsfix_failed(app);
}

// ---- ffmpeg ------------------------------------------------------------------------

#ifdef _WIN32
#define VIDEO_QUOTED "\"%s\""
#else
#define VIDEO_QUOTED "%s"
#endif

static gsf_result start_ffmpeg(gsfix_video* v) {
    gsfix_path found, draft;
    const gsfix_path size = gsfix_pathf("%dx%d", (int)v->canvas.width, (int)v->canvas.height);
    const gsfix_path rate = gsfix_pathf("%d", v->fps);
    v->name = gsfix_pathf("--video %s: ffmpeg", v->app->o.video);
    v->ffmpeg.name = v->name.s;
    v->ffmpeg.code = GSF_ERROR_IO;
    if (!gsfix_find_program("ffmpeg", &found))
        return gsf_fail(&v->app->ctx, GSF_ERROR_IO, "%s is not in PATH any more", v->name.s);
    const gsf_result result = gsfix_begin_draft(v->app, &draft);
    if (result != GSF_OK) return result;
    const gsfix_path program = gsfix_pathf(VIDEO_QUOTED, found.s), file = gsfix_pathf(VIDEO_QUOTED, draft.s);
    const int mp4 = v->kind == VIDEO_MP4;
    // The codecs are ffmpeg's own choice for the format, usually H.264 and VP9. Colours as televisions and browsers have them.
    const char* const arguments[] = {
        program.s, "-hide_banner", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-video_size", size.s,
        "-framerate", rate.s, "-i", "-", "-vf", "scale=out_color_matrix=bt709:out_range=tv", "-pix_fmt", "yuv420p",
        "-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709", "-color_range", "tv",
        "-crf", mp4 ? "18" : "24", "-b:v", "0", "-movflags", "+faststart", "-f", mp4 ? "mp4" : "webm", "-n", file.s, NULL};
    return gsfix_start_process(&v->app->ctx, &v->ffmpeg, arguments, 1);
}

// ---- animated PNG ------------------------------------------------------------------
/* PNG signature, IHDR, acTL, then per frame fcTL and its data: IDAT for the first one, which a viewer without animation shows,
   fdAT for the others; IEND. fcTL and fdAT are numbered in one sequence. */

static uint32_t load_be32(const char* data) {
    const unsigned char* p = (const unsigned char*)data;
    return (uint32_t)p[0] << 24 | (uint32_t)p[1] << 16 | (uint32_t)p[2] << 8 | p[3];
}

static void store_be32(char* out, uint32_t value) {
    for (int i = 0; i < 4; i++) out[i] = (char)(value >> (24 - 8 * i) & 255);
}

static uint32_t crc32_of(const uint32_t table[256], uint32_t crc, const char* data, size_t size) {
    for (size_t i = 0; i < size; i++) crc = crc >> 8 ^ table[(crc ^ (unsigned char)data[i]) & 255];
    return crc;
}

// head: the first `head_size` bytes of the chunk's content.
static void put_chunk(gsfix_video* v, const char* type, const char* head, size_t head_size, const char* data, size_t size) {
    gsf_context* ctx = &v->app->ctx;
    uint32_t table[256], crc = 0xffffffffu;
    char number[4];
    for (uint32_t i = 0; i < 256; i++) {
        table[i] = i;
        for (int k = 0; k < 8; k++) table[i] = table[i] >> 1 ^ (table[i] & 1 ? 0xedb88320u : 0);
    }
    crc = crc32_of(table, crc, type, 4);
    crc = crc32_of(table, crc, head, head_size);
    crc = crc32_of(table, crc, data, size);
    store_be32(number, (uint32_t)(head_size + size));
    gsf_append_bytes(ctx, &v->png, number, 4);
    gsf_append_bytes(ctx, &v->png, type, 4);
    gsf_append_bytes(ctx, &v->png, head, head_size);
    gsf_append_bytes(ctx, &v->png, data, size);
    store_be32(number, ~crc);
    gsf_append_bytes(ctx, &v->png, number, 4);
}

static void put_frame_control(gsfix_video* v) {
    char control[26] = {0}; // offsets, disposal and blending: 0
    store_be32(control, v->sequence++);
    store_be32(control + 4, (uint32_t)v->canvas.width);
    store_be32(control + 8, (uint32_t)v->canvas.height);
    control[21] = 1; // duration of 1/fps
    control[23] = (char)v->fps;
    put_chunk(v, "fcTL", control, sizeof control, "", 0);
}

static gsf_result add_png(gsfix_video* v) {
    gsf_buffer frame = {0};
    gsf_result result = gsf_encode_image(&v->app->ctx, &v->canvas, ".png", &frame);
    if (result == GSF_OK && !v->added) {
        char animation[8] = {0}; // the last four bytes: for ever
        store_be32(animation, (uint32_t)v->frames);
        gsf_append_bytes(&v->app->ctx, &v->png, frame.data, 8 + 25); // signature and IHDR
        put_chunk(v, "acTL", animation, sizeof animation, "", 0);
    }
    if (result == GSF_OK) put_frame_control(v);
    for (size_t at = 8; result == GSF_OK && at + 12 <= frame.size; at += 12 + load_be32(frame.data + at)) {
        char number[4];
        if (memcmp(frame.data + at + 4, "IDAT", 4) != 0) continue;
        store_be32(number, v->sequence);
        if (v->added) v->sequence++;
        put_chunk(v, v->added ? "fdAT" : "IDAT", number, v->added ? 4 : 0, frame.data + at + 8, load_be32(frame.data + at));
    }
    gsf_destroy_buffer(&v->app->ctx, &frame);
    return result == GSF_OK && v->png.failed ? GSF_ERROR_OUT_OF_MEMORY : result;
}

// ---- page --------------------------------------------------------------------------

static const char* const player_style[] = {
    "<style>html,body{height:100%}body{max-width:none;margin:0;padding:0;display:flex;flex-direction:column}",
    "#stage{flex:1;min-height:0;display:flex;background:#111;cursor:pointer}",
    "#stage canvas{width:100%;height:100%;object-fit:contain;display:block;background:none}",
    "#bar{display:flex;flex-wrap:wrap;gap:8px 14px;align-items:center;padding:10px 16px;background:var(--card);color:var(--ink)}",
    "#bar input{flex:1 1 200px;accent-color:var(--accent)}#bar output{font-variant-numeric:tabular-nums;color:var(--soft);min-width:7em}",
    "#bar select{font:inherit;background:var(--card);color:var(--ink);border:1px solid var(--line);border-radius:6px;padding:3px 6px}",
    "#bar button{min-width:5.5em}</style>\n", NULL};

static const char* const player_script[] = {
    "(function(){'use strict';function el(id){return document.getElementById(id)}\n",
    "var d=JSON.parse(el('data').textContent),n=d.frames.length,c=el('view'),x=c.getContext('2d'),images=[],at=0,shown=-1,way=1,due=0;\n",
    "var playing=!matchMedia('(prefers-reduced-motion: reduce)').matches;el('time').max=n-1;\n",
    // Decodes a few frames ahead, so that a long video does not fill the memory.
    "function image(i){i=(i%n+n)%n;if(!images[i]){images[i]=new Image();images[i].onload=function(){if(i===at)draw()};\n",
    " images[i].src='data:image/jpeg;base64,'+d.frames[i]}return images[i].complete&&images[i].naturalWidth?images[i]:null}\n",
    "function draw(){var p=image(at);for(var k=1;k<9;k++)image(at+way*k);\n",
    " for(var i in images){var far=Math.abs(i-at);if(Math.min(far,n-far)>24)delete images[i]}\n",
    " if(p&&shown!==at){x.drawImage(p,0,0,c.width,c.height);shown=at}el('time').value=at;el('play').textContent=playing?'Pause':'Play';\n",
    " el('count').textContent=(at+1)+' of '+n+', '+(at/d.fps).toFixed(2)+' s'}\n",
    "function step(by){at+=by;if(at<0||at>=n){if(el('repeat').value==='swing'&&n>1){way=-way;at=at<0?1:n-2}else at=(at+n)%n}draw()}\n",
    "function tick(now){if(playing&&shown===at&&n>1){var wait=1000/d.fps/+el('speed').value;if(!due||now-due>500)due=now;\n",
    " if(now>=due){due+=wait;step(way)}}else if(!playing)due=0;requestAnimationFrame(tick)}\n",
    "function toggle(){playing=!playing;draw()}function move(by){playing=false;at=Math.max(0,Math.min(n-1,at+by));draw()}\n",
    "el('play').onclick=el('stage').onclick=toggle;el('time').oninput=function(){playing=false;at=+this.value;draw()};\n",
    "el('repeat').onchange=function(){way=1};\n",
    "document.onkeydown=function(e){if(/SELECT|INPUT|BUTTON/.test(e.target.tagName)&&e.key===' ')return;\n",
    " var by={ArrowLeft:-1,ArrowRight:1,Home:-n,End:n}[e.key];if(e.key===' ')toggle();else if(by&&e.target.tagName!=='SELECT')move(by);else return;\n",
    " e.preventDefault()};draw();requestAnimationFrame(tick)})();", NULL};

static void begin_page(gsfix_video* v) {
    gsfix_page* p = &v->page;
    const char* slash = strrchr(v->app->o.video, '/');
    const int64_t side = v->canvas.width > v->canvas.height ? v->canvas.width : v->canvas.height;
    const double shrink = side > VIDEO_SIDE ? (double)VIDEO_SIDE / (double)side : 1.0;
    p->ctx = &v->app->ctx;
    gsfix_put_head(p, slash ? slash + 1 : v->app->o.video);
    gsfix_put_lines(p, player_style);
    gsfix_put(p, "<div id=stage><canvas id=view width=%d height=%d></canvas></div>\n",
              (int)((double)v->canvas.width * shrink + 0.5), (int)((double)v->canvas.height * shrink + 0.5));
    gsfix_put_raw(p, "<noscript><p>The frames are played by a script, which is switched off here.</p></noscript>\n"
                     "<div id=bar><button id=play>Pause</button><input id=time type=range min=0 value=0 aria-label=frame>"
                     "<output id=count></output><select id=speed aria-label=speed><option value=0.25>quarter speed<option value=0.5>"
                     "half speed<option value=1 selected>full speed<option value=2>double speed</select><select id=repeat "
                     "aria-label=\"at the end\"><option value=loop>from the start again<option value=swing>back and forth</select>"
                     "</div>\n");
    gsfix_put(p, "<script type=\"application/json\" id=data>{\"fps\":%d,\"frames\":[", v->fps);
}

static gsf_result add_to_page(gsfix_video* v) {
    gsfix_put_raw(&v->page, v->added ? ",\n\"" : "\n\"");
    const gsf_result result = gsfix_put_jpeg(&v->page, &v->canvas, VIDEO_SIDE, NULL, NULL);
    gsfix_put_raw(&v->page, "\"");
    return result;
}

static void end_page(gsfix_video* v) {
    gsfix_put_raw(&v->page, "]}</script>\n<script>");
    gsfix_put_lines(&v->page, player_script);
    gsfix_put_raw(&v->page, "</script></body></html>\n");
}

// ---- frames ------------------------------------------------------------------------

gsf_result gsfix_begin_video(gsfix_app* app, int64_t width, int64_t height, size_t frames, gsfix_video** out) {
    static const gsfix_video zero;
    gsf_context* ctx = &app->ctx;
    *out = NULL;
    if (!app->o.video) return GSF_OK;
    if (!frames) {
        gsfix_note(app, "%s: not written, since there are no frames", app->o.video);
        return GSF_OK;
    }
    gsfix_video* v = (gsfix_video*)gsf_alloc(ctx, 1, sizeof *v);
    if (!v) return GSF_ERROR_OUT_OF_MEMORY;
    *v = zero;
    v->app = app;
    v->fps = app->o.fps ? app->o.fps : VIDEO_FPS;
    v->frames = frames;
    find_kind(app->o.video, &v->kind);
    const int even = v->kind <= VIDEO_WEBM;
    gsf_result result = gsf_make_image(ctx, GSF_U8, width + (even ? width % 2 : 0), height + (even ? height % 2 : 0), 3,
                                       &v->canvas);
    if (result == GSF_OK && even) result = start_ffmpeg(v);
    if (result == GSF_OK && v->kind == VIDEO_HTML) begin_page(v);
    if (result == GSF_OK) *out = v;
    else gsfix_destroy_video(v);
    return result;
}

// Copies the frame into the middle of the canvas; an edge that the canvas has in addition repeats the frame's last one.
static gsf_result fill_canvas(gsfix_video* v, const gsf_image* frame) {
    const gsf_image* c = &v->canvas;
    gsf_image part = *c;
    unsigned char* bytes = (unsigned char*)c->data;
    const int64_t x = (c->width - frame->width) / 2, y = (c->height - frame->height) / 2;
    if (x < 0 || y < 0) return gsf_fail(&v->app->ctx, GSF_ERROR_INVALID_ARGUMENT, "--video: a frame is larger than the video");
    if (x || y) memset(bytes, 0, (size_t)(c->height * c->stride_y));
    part.width = frame->width;
    part.height = frame->height;
    part.data = bytes + y * c->stride_y + x * c->stride_x;
    const gsf_result result = gsf_convert_image(&v->app->ctx, frame, &part);
    if (frame->width + 1 == c->width)
        for (int64_t row = 0; row < c->height; row++) {
            unsigned char* end = bytes + row * c->stride_y + (c->width - 1) * c->stride_x;
            memcpy(end, end - c->stride_x, 3);
        }
    if (frame->height + 1 == c->height)
        memcpy(bytes + (c->height - 1) * c->stride_y, bytes + (c->height - 2) * c->stride_y, (size_t)c->stride_y);
    return result;
}

gsf_result gsfix_add_frame(gsfix_video* v, const gsf_image* frame) {
    if (!v) return GSF_OK;
    gsf_result result = fill_canvas(v, frame);
    if (result != GSF_OK) return result;
    if (v->kind == VIDEO_PNG) result = add_png(v);
    else if (v->kind == VIDEO_HTML) result = add_to_page(v);
    else
        result = gsfix_feed_process(&v->app->ctx, &v->ffmpeg, v->canvas.data, (size_t)(v->canvas.height * v->canvas.stride_y),
                                    VIDEO_STALL);
    v->added++;
    return result;
}

gsf_result gsfix_finish_video(gsfix_video* v) {
    if (!v) return GSF_OK;
    gsf_context* ctx = &v->app->ctx;
    const char* path = v->app->o.video;
    if (v->kind == VIDEO_PNG) {
        put_chunk(v, "IEND", "", 0, "", 0);
        return v->png.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf_write_file(ctx, path, v->png.data, v->png.size);
    }
    if (v->kind == VIDEO_HTML) {
        end_page(v);
        return v->page.html.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf_write_file(ctx, path, v->page.html.data, v->page.html.size);
    }
    gsf_result result = gsfix_wait_process(ctx, &v->ffmpeg, VIDEO_STALL);
    gsfix_end_process(&v->ffmpeg);
    return result == GSF_OK ? gsfix_publish_draft(v->app, path) : result;
}

void gsfix_destroy_video(gsfix_video* v) {
    if (!v) return;
    gsf_context* ctx = &v->app->ctx;
    if (v->kind <= VIDEO_WEBM) {
        gsfix_end_process(&v->ffmpeg);
        gsfix_drop_draft(v->app);
    }
    gsf_destroy_image(ctx, &v->canvas);
    gsf_destroy_buffer(ctx, &v->png);
    gsf_destroy_buffer(ctx, &v->page.html);
    gsf_free(ctx, v);
}
