// gsfix_report.c - DIR/report.html: a self-contained page about a run; it makes no network requests
// SPDX-License-Identifier: MIT
#include "gsfix.h"

#include <math.h>
#include <stdarg.h>

enum {
    PICTURE_SIDE = 512,        // longer side of an embedded picture, pixels
    VIEW_BYTES = 3400000,      // share of the file for the held-out views
    SAMPLE_BYTES = 1100000,    // share of the file for the repaired frames
    VIEWS_MOST = 12, SAMPLES_MOST = 6, CLOUD_POINTS = 6000,
};
const double gsfix_error_white = 0.3; // mean absolute error at the bright end of the error maps

typedef gsfix_page page;

void gsfix_put(page* p, const char* format, ...) {
    char text[4096];
    va_list args;
    va_start(args, format);
    const int n = vsnprintf(text, sizeof text, format, args);
    va_end(args);
    gsf_append_bytes(p->ctx, &p->html, text, n < 0 ? 0 : (size_t)n < sizeof text ? (size_t)n : sizeof text - 1);
}

void gsfix_put_raw(page* p, const char* text) { gsf_append_bytes(p->ctx, &p->html, text, strlen(text)); }

void gsfix_put_lines(page* p, const char* const* lines) {
    for (; *lines; lines++) gsfix_put_raw(p, *lines);
}

void gsfix_put_escaped(page* p, const char* text) {
    for (; *text; text++) {
        const char* as = *text == '&' ? "&amp;" : *text == '<' ? "&lt;" : *text == '>' ? "&gt;" : *text == '"' ? "&quot;" : NULL;
        if (as) gsfix_put_raw(p, as);
        else gsf_append_bytes(p->ctx, &p->html, text, 1);
    }
}

static void put_base64(page* p, const char* data, size_t size) {
    static const char digits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    char out[4096];
    size_t used = 0;
    for (size_t i = 0; i < size; i += 3) {
        const unsigned char* b = (const unsigned char*)data + i;
        const size_t left = size - i;
        const unsigned v = (unsigned)b[0] << 16 | (left > 1 ? (unsigned)b[1] << 8 : 0) | (left > 2 ? b[2] : 0u);
        out[used++] = digits[v >> 18];
        out[used++] = digits[v >> 12 & 63];
        out[used++] = left > 1 ? digits[v >> 6 & 63] : '=';
        out[used++] = left > 2 ? digits[v & 63] : '=';
        if (used == sizeof out) gsf_append_bytes(p->ctx, &p->html, out, used), used = 0;
    }
    gsf_append_bytes(p->ctx, &p->html, out, used);
}

// ---- images ----------------------------------------------------------------------

gsf_result gsfix_put_jpeg(page* p, const gsf_image* image, int64_t most, int64_t* width, int64_t* height) {
    gsf_image small = {0};
    gsf_buffer bytes = {0};
    const int64_t side = image->width > image->height ? image->width : image->height;
    const gsf_image* shown = image;
    gsf_result result = GSF_OK;
    if (side > most) {
        const int64_t w = (image->width * most + side / 2) / side, h = (image->height * most + side / 2) / side;
        result = gsf_make_image(p->ctx, GSF_U8, w > 0 ? w : 1, h > 0 ? h : 1, image->channels, &small);
        if (result == GSF_OK) result = gsf_resize_image(p->ctx, image, GSF_RESIZE_PIL_LANCZOS, &small);
        shown = &small;
    }
    if (result == GSF_OK) result = gsf_encode_image(p->ctx, shown, ".jpg", &bytes);
    if (result == GSF_OK) put_base64(p, bytes.data, bytes.size);
    if (width) *width = shown->width;
    if (height) *height = shown->height;
    gsf_destroy_buffer(p->ctx, &bytes);
    gsf_destroy_image(p->ctx, &small);
    return result;
}

static gsf_result put_image(page* p, const gsf_image* image, const char* alt) { // u8; large images are shrunk
    int64_t width, height;
    gsfix_put(p, "<img alt=\"%s\" src=\"data:image/jpeg;base64,", alt);
    const gsf_result result = gsfix_put_jpeg(p, image, PICTURE_SIDE, &width, &height);
    gsfix_put(p, "\" width=%d height=%d>", (int)width, (int)height);
    return result;
}

static gsf_result put_error_map(page* p, const gsf_image* a, const gsf_image* b, const char* alt) {
    gsf_image error = {0}, picture = {0};
    gsf_result result = gsfix_mean_abs_error(p->ctx, a, b, &error);
    if (result == GSF_OK) result = gsfix_color_map(p->ctx, &error, 0.0, gsfix_error_white, &picture);
    if (result == GSF_OK) result = put_image(p, &picture, alt);
    gsf_destroy_image(p->ctx, &error);
    gsf_destroy_image(p->ctx, &picture);
    return result;
}

static gsf_result put_pane(page* p, const char* key, const char* side, const char* label, const gsf_image* a,
                           const gsf_image* b) { // b: show the difference from this image
    gsfix_put(p, "<div class=\"pane%s%s\" data-k=\"%s\">", *side ? " " : "", side, key);
    const gsf_result result = b ? put_error_map(p, a, b, label) : put_image(p, a, label);
    gsfix_put(p, "<span>%s</span></div>", label);
    return result;
}

static void put_change(page* p, const char* name, double without, double with, int digits, const char* unit) {
    if (isnan(with)) return;
    gsfix_put(p, "<span>%s ", name);
    if (!isnan(without)) gsfix_put(p, "%.*f &rarr; ", digits, without);
    gsfix_put(p, "<b>%.*f</b>%s</span>", digits, with, unit);
}

static gsf_result put_view(page* p, size_t i) {
    const gsfix_result* r = p->r;
    const gsf_scene_view* view = &r->scene->views[r->split->test[i]];
    const int has_without = r->history->has_without;
    const gsfix_path stem = gsfix_view_stem(r->scene, r->split->test[i]);
    gsf_image without = {0}, with = {0}, filtered = {0};
    gsf_result result = gsf_load_image(p->ctx, gsfix_pathf("%s/test/%s.png", r->out, stem.s).s, 3, &with);
    if (result == GSF_OK && has_without)
        result = gsf_load_image(p->ctx, gsfix_pathf("%s/report/without/%s.png", r->out, stem.s).s, 3, &without);
    if (result == GSF_OK && r->filtered_views)
        result = gsf_load_image(p->ctx, gsfix_pathf("%s/filtered/%s.png", r->out, stem.s).s, 3, &filtered);
    gsfix_put(p, "<figure class=card><div class=cmp style=\"aspect-ratio:%d/%d\">", (int)with.width, (int)with.height);
    if (result == GSF_OK) result = put_pane(p, "photo", has_without ? "" : "left", "photo", &view->image, NULL);
    if (result == GSF_OK && has_without) result = put_pane(p, "without", "left", "without repair", &without, NULL);
    if (result == GSF_OK) result = put_pane(p, "with", "right", has_without ? "with repair" : "result", &with, NULL);
    if (result == GSF_OK && r->filtered_views) result = put_pane(p, "filtered", "", "filtered", &filtered, NULL);
    if (result == GSF_OK && has_without) result = put_pane(p, "error-without", "", "error without", &without, &view->image);
    if (result == GSF_OK) result = put_pane(p, "error", "", has_without ? "error with" : "error", &with, &view->image);
    gsfix_put_raw(p, "<i class=bar></i><input type=range min=0 max=1000 value=500 aria-label=\"divider between the two pictures\"></div>"
               "<figcaption><strong>");
    gsfix_put_escaped(p, view->name);
    gsfix_put_raw(p, "</strong>");
    const gsfix_score* was = has_without ? &r->history->without[i] : NULL;
    put_change(p, "PSNR", was ? was->psnr : NAN, r->views[i].psnr, 2, " dB");
    put_change(p, "seen", was ? was->psnr_seen : NAN, r->views[i].psnr_seen, 2, " dB");
    put_change(p, "SSIM", was ? was->ssim : NAN, r->views[i].ssim, 3, "");
    if (r->filtered_views) put_change(p, "filtered", NAN, r->filtered_views[i].psnr, 2, " dB");
    gsfix_put_raw(p, "</figcaption></figure>\n");
    gsf_destroy_image(p->ctx, &without);
    gsf_destroy_image(p->ctx, &with);
    gsf_destroy_image(p->ctx, &filtered);
    return result;
}

void gsfix_put_legend(page* p) { // colour scale of the error maps
    gsfix_put_raw(p, "<div class=legend><span>error per pixel</span><span class=num>0</span><i style=\"background:linear-gradient(90deg");
    for (int i = 0; i <= 10; i++) {
        uint8_t c[3];
        gsfix_map_color(i / 10.0, c);
        gsfix_put(p, ",rgb(%d,%d,%d)", c[0], c[1], c[2]);
    }
    gsfix_put(p, ")\"></i><span class=num>&ge; %.1f</span><span>mean absolute difference from the photo, colours from 0 to 1</span></div>\n",
        gsfix_error_white);
}

static gsf_result put_views(page* p) {
    const gsfix_result* r = p->r;
    const size_t count = r->split->test_count;
    if (!count) return GSF_OK;
    gsfix_put_raw(p, "<section><h2>Held-out views</h2><p>Photos that were not used for training. Drag the divider in an image to compare.");
    if (r->history->has_without)
        gsfix_put(p, " <em>Without repair</em> is a second run from the same start and seed with the same number of steps (%d): the "
               "difference, %+.2f dB on average, is what the repair%s contributes.",
            (int)r->iterations, (r->copies > 1 ? r->first_copy : r->mean.psnr) - r->without.psnr,
            r->copies > 1 ? " in one copy" : " alone");
    if (r->copies > 1)
        gsfix_put(p, " The splats join %zu copies, trained with different seeds: %+.2f dB over the first of them.", r->copies,
               r->mean.psnr - r->first_copy);
    if (r->filtered_views) {
        gsfix_put(p, " <em>Filtered</em> are the same renders%s cleaned up by the restorer, %+.2f dB on average; the splats stay as they are.",
            r->copies > 1 ? ", together with those of the copies," : "", r->filtered.psnr - r->mean.psnr);
    }
    gsfix_put_raw(p, "</p>\n<div class=choice role=group aria-label=\"pictures to compare\">");
    if (r->history->has_without)
        gsfix_put_raw(p, "<button data-l=without data-r=with class=on>without | with repair</button><button data-l=photo data-r=with>photo | "
                   "with repair</button><button data-l=photo data-r=without>photo | without repair</button>"
                   "<button data-l=error-without data-r=error>error without | with repair</button>");
    else
        gsfix_put_raw(p, "<button data-l=photo data-r=with class=on>photo | result</button><button data-l=with data-r=error>result | error"
                   "</button>");
    if (r->filtered_views)
        gsfix_put(p, "<button data-l=with data-r=filtered>%s | filtered</button><button data-l=photo data-r=filtered>photo | filtered"
                  "</button>", r->history->has_without ? "with repair" : "result");
    gsfix_put_raw(p, "</div>\n");
    gsfix_put_legend(p);
    gsfix_put_raw(p, "<div class=\"cards\">\n");
    const size_t begin = p->html.size;
    gsf_result result = put_view(p, 0);
    const size_t each = p->html.size - begin;
    size_t shown = each ? VIEW_BYTES / each : 1;
    if (shown > VIEWS_MOST) shown = VIEWS_MOST;
    if (shown > count) shown = count;
    for (size_t k = 1; k < shown && result == GSF_OK; k++) result = put_view(p, k * count / shown);
    gsfix_put_raw(p, "</div>");
    if (shown < count) gsfix_put(p, "<p class=small>%zu of %zu held-out views are shown; all are in test/ and in the table below.</p>", shown, count);
    gsfix_put_raw(p, "</section>\n");
    return result;
}

static gsf_result put_sample(page* p, const gsfix_sample* s) {
    static const char* const names[] = {"render", "restored", "confidence"};
    static const char* const labels[] = {"render", "repaired", "confidence"};
    gsf_result result = GSF_OK;
    gsfix_put_raw(p, "<figure class=\"card triple\"><div>");
    for (int k = 0; k < 3 && result == GSF_OK; k++) {
        gsf_image image = {0};
        result = gsf_load_image(p->ctx, gsfix_pathf("%s/report/round%d_window%d_%s.png", p->r->out, (int)s->round,
                                                    (int)s->window, names[k]).s, k == 2 ? 1 : 3, &image);
        gsfix_put_raw(p, "<div class=still>");
        if (result == GSF_OK) result = put_image(p, &image, labels[k]);
        gsfix_put(p, "<span>%s</span></div>", labels[k]);
        gsf_destroy_image(p->ctx, &image);
    }
    gsfix_put(p, "</div><figcaption><strong>round %d, window %d</strong><span>fixed/round%d_window%d_%05d.png</span></figcaption>"
           "</figure>\n", (int)s->round, (int)s->window, (int)s->round, (int)s->window, (int)s->frame);
    return result;
}

static gsf_result put_samples(page* p) {
    const gsfix_history* h = p->r->history;
    if (!h->sample_count) return GSF_OK;
    int restored = 0, skipped = 0;
    for (size_t i = 0; i < h->round_count; i++) restored += h->rounds[i].frames, skipped += h->rounds[i].skipped;
    gsfix_put(p, "<section><h2>Repaired frames</h2><p>Between training steps, frames along a camera path are rendered and repaired, and "
           "training continues on the photos and the repaired frames: %d frames in %zu rounds", restored, h->round_count);
    if (skipped) gsfix_put(p, ", %d windows skipped because their render already agreed with the photos", skipped);
    gsfix_put_raw(p, ". Confidence is the weight of each pixel in training; black pixels, seams and mere guesses, are "
               "ignored.</p>\n<div class=\"cards broad\">\n");
    const size_t begin = p->html.size;
    gsf_result result = put_sample(p, &h->samples[0]);
    const size_t each = p->html.size - begin;
    size_t shown = each ? SAMPLE_BYTES / each : 1;
    if (shown > SAMPLES_MOST) shown = SAMPLES_MOST;
    if (shown > h->sample_count) shown = h->sample_count;
    for (size_t k = 1; k < shown && result == GSF_OK; k++) result = put_sample(p, &h->samples[k * h->sample_count / shown]);
    gsfix_put_raw(p, "</div></section>\n");
    return result;
}

// ---- figures ---------------------------------------------------------------------

static void put_count(page* p, double x) { // 12345 as 12,345
    char digits[32];
    const int n = snprintf(digits, sizeof digits, "%.0f", x);
    for (int i = 0; i < n; i++) gsfix_put(p, "%c%s", digits[i], (n - 1 - i) % 3 == 0 && i + 1 < n && digits[i] != '-' ? "," : "");
}

static void put_tile(page* p, const char* name, double value, double without, int digits, const char* unit) {
    if (isnan(value)) return;
    gsfix_put(p, "<div class=tile><dt>%s</dt><dd>%.*f<small>%s</small></dd>", name, digits, value, unit);
    if (!isnan(without))
        gsfix_put(p, "<p class=%s>%+.*f%s from repair %s</p>", value >= without ? "up" : "down", digits, value - without, unit,
                  p->r->copies > 1 ? "and copies" : "alone");
    gsfix_put_raw(p, "</div>\n");
}

static void put_tiles(page* p) {
    const gsfix_result* r = p->r;
    const double seconds = r->history->seconds_total;
    const int has_without = r->history->has_without;
    gsfix_put_raw(p, "<dl class=tiles>\n");
    put_tile(p, "PSNR, held-out", r->mean.psnr, has_without ? r->without.psnr : NAN, 2, " dB");
    put_tile(p, "PSNR, seen pixels", r->mean.psnr_seen, has_without ? r->without.psnr_seen : NAN, 2, " dB");
    put_tile(p, "SSIM, held-out", r->mean.ssim, has_without ? r->without.ssim : NAN, 3, "");
    if (r->filtered_views) put_tile(p, "PSNR, filtered views", r->filtered.psnr, NAN, 2, " dB");
    gsfix_put(p, "<div class=tile><dt>photos used</dt><dd>%zu<small> of %zu</small></dd></div>\n", r->split->train_count, r->scene->view_count);
    gsfix_put_raw(p, "<div class=tile><dt>splats</dt><dd>");
    put_count(p, (double)r->splats->count);
    gsfix_put_raw(p, "</dd></div>\n<div class=tile><dt>time</dt><dd>");
    if (seconds < 120.0) gsfix_put(p, "%.1f<small> s</small>", seconds);
    else gsfix_put(p, "%.1f<small> min</small>", seconds / 60.0);
    gsfix_put(p, "</dd><p>%d steps</p></div>\n", (int)r->iterations);
    gsfix_put(p, "<div class=tile><dt>memory, peak</dt><dd>%.0f<small> MB</small></dd></div>\n</dl>\n", (double)gsfix_peak_memory() / 1e6);
}

static double nice_step(double range, int wanted) {
    const double raw = range / wanted, power = pow(10.0, floor(log10(raw))), share = raw / power;
    return power * (share <= 1.0 ? 1.0 : share <= 2.0 ? 2.0 : share <= 5.0 ? 5.0 : 10.0);
}

typedef struct plot { double x0, y0, sx, sy; } plot; // iteration, dB -> SVG units

static void put_line(page* p, const plot* f, const gsfix_curve_point* points, size_t count, int seen, const char* kind,
                     const char* name) {
    gsfix_put(p, "<polyline class=\"%s\" points=\"", kind);
    for (size_t i = 0; i < count; i++) {
        const double y = seen ? points[i].psnr_seen : points[i].psnr;
        if (!isnan(y)) gsfix_put(p, "%.1f,%.1f ", f->x0 + f->sx * points[i].iteration, f->y0 - f->sy * y);
    }
    gsfix_put_raw(p, "\"/>");
    for (size_t i = 0; i < count; i++) {
        const double y = seen ? points[i].psnr_seen : points[i].psnr;
        if (!isnan(y))
            gsfix_put(p, "<circle class=\"%s\" cx=%.1f cy=%.1f r=3.2><title>step %d: %.2f dB (%s), %llu splats</title></circle>", kind,
                f->x0 + f->sx * points[i].iteration, f->y0 - f->sy * y, (int)points[i].iteration, y, name,
                (unsigned long long)points[i].splats);
    }
}

// Widens low..high to the PSNR values of a curve; returns whether any of them is over seen pixels.
static int curve_range(const gsfix_curve_point* points, size_t count, double* low, double* high) {
    int has_seen = 0;
    for (size_t i = 0; i < count; i++)
        for (int k = 0; k < 2; k++) {
            const double y = k ? points[i].psnr_seen : points[i].psnr;
            if (!isfinite(y)) continue;
            *low = y < *low ? y : *low;
            *high = y > *high ? y : *high;
            has_seen |= k;
        }
    return has_seen;
}

static void put_curve(page* p) {
    const gsfix_history* h = p->r->history;
    double low = 1e9, high = -1e9;
    const int has_seen = curve_range(h->curve, h->curve_count, &low, &high);
    (void)curve_range(h->without_curve, h->without_count, &low, &high);
    if (low > high) return;
    const double step = nice_step(high - low > 0.5 ? high - low : 0.5, 5), last = p->r->iterations;
    low = step * floor(low / step - 0.1);
    high = step * ceil(high / step + 0.1);
    enum { LEFT = 46, RIGHT = 700, TOP = 26, BOTTOM = 250 };
    plot f;
    f.sx = (RIGHT - LEFT) / last;
    f.x0 = LEFT;
    f.sy = (BOTTOM - TOP) / (high - low);
    f.y0 = BOTTOM + f.sy * low;
    gsfix_put_raw(p, "<section><h2>PSNR over the steps</h2><p>Mean over the held-out views, measured while training");
    if (p->r->copies > 1) gsfix_put_raw(p, " the first copy");
    if (h->round_count) gsfix_put_raw(p, "; vertical lines mark repair rounds");
    gsfix_put_raw(p, ".</p>\n<svg class=chart viewBox=\"0 0 720 290\" role=img aria-label=\"PSNR over training steps\">");
    for (double y = low; y <= high + 0.01 * step; y += step)
        gsfix_put(p, "<line class=grid x1=%d x2=%d y1=%.1f y2=%.1f /><text x=%d y=%.1f text-anchor=end>%.*f</text>", LEFT, RIGHT,
            f.y0 - f.sy * y, f.y0 - f.sy * y, LEFT - 8, f.y0 - f.sy * y + 4.0, step < 1.0 ? 1 : 0, y);
    const double x_step = nice_step(last, 6);
    for (double x = 0.0; x <= last * 1.001; x += x_step)
        gsfix_put(p, "<text x=%.1f y=%d text-anchor=middle>%.0f</text>", f.x0 + f.sx * x, BOTTOM + 20, x);
    gsfix_put(p, "<text x=%d y=14>dB</text><text x=%d y=%d text-anchor=end>step</text>", 12, RIGHT, BOTTOM + 36);
    for (size_t i = 0; i < h->round_count; i++) {
        const double x = f.x0 + f.sx * h->rounds[i].iteration;
        gsfix_put(p, "<line class=round x1=%.1f x2=%.1f y1=%d y2=%d /><text class=round x=%.1f y=%d>%s%d</text>", x, x, TOP - 18, BOTTOM,
            x + 5.0, TOP - 9, i ? "" : "round ", (int)h->rounds[i].round); // rounds can be too close for more text
    }
    if (has_seen && h->without_count) put_line(p, &f, h->without_curve, h->without_count, 1, "seen without", "seen pixels, without repair");
    if (h->without_count) put_line(p, &f, h->without_curve, h->without_count, 0, "all without", "all pixels, without repair");
    if (has_seen) put_line(p, &f, h->curve, h->curve_count, 1, "seen", "seen pixels");
    put_line(p, &f, h->curve, h->curve_count, 0, "all", "all pixels");
    gsfix_put_raw(p, "</svg>\n");
    if (has_seen || h->without_count) {
        gsfix_put_raw(p, "<p class=keys><span><i class=all></i>all pixels</span>");
        if (has_seen) gsfix_put_raw(p, "<span><i class=seen></i>pixels that a training view sees</span>");
        if (h->without_count) gsfix_put_raw(p, "<span><i class=\"all without\"></i>paler: as many steps without repair</span>");
        gsfix_put_raw(p, "</p>");
    }
    gsfix_put_raw(p, "</section>\n");
}

static void put_seconds(page* p) {
    static const char* const what[GSFIX_STAGES] = {"loading, visible points, initial splats", "training before the first round",
                                                   "rendering and measuring held-out views", "rendering and repairing path frames",
                                                   "training with repaired frames", "writing checkpoints for --resume",
                                                   "writing images and splats", "run without repair, for comparison",
                                                   "copies with other seeds, and joining them"};
    const gsfix_history* h = p->r->history;
    double sum = 0.0;
    for (int i = 0; i < GSFIX_STAGES; i++) sum += h->seconds[i];
    gsfix_put_raw(p, "<section><h2>Where the time went</h2><div class=stages>");
    for (int i = 0; i < GSFIX_STAGES; i++)
        if (h->seconds[i] > 0.002 * sum)
            gsfix_put(p, "<i class=s%d style=\"flex-grow:%.3f\" title=\"%s: %.1f s\"></i>", i, h->seconds[i] / sum, gsfix_stage_names[i], h->seconds[i]);
    gsfix_put_raw(p, "</div><table class=plain>");
    for (int i = 0; i < GSFIX_STAGES; i++)
        if (h->seconds[i] > 0.0)
            gsfix_put(p, "<tr><td><i class=\"dot s%d\"></i>%s<td class=num>%.1f s<td class=num>%.0f %%<td class=wide>%s</tr>", i, gsfix_stage_names[i],
                h->seconds[i], 100.0 * h->seconds[i] / sum, what[i]);
    gsfix_put(p, "<tr class=mean><td>total<td class=num>%.1f s<td><td class=wide></tr></table></section>\n", h->seconds_total);
}

static void put_cell(page* p, double value, int digits) {
    if (isnan(value)) gsfix_put_raw(p, "<td class=num>&ndash;");
    else gsfix_put(p, "<td class=num>%.*f", digits, value);
}

static void put_table(page* p) {
    const gsfix_result* r = p->r;
    const int has_without = r->history->has_without, has_seen = r->masks != NULL;
    if (!r->split->test_count) return;
    gsfix_put_raw(p, "<section><h2>Metrics per view</h2><div class=scroll><table><thead><tr><th>view");
    if (has_without) gsfix_put_raw(p, "<th>PSNR without repair, dB");
    gsfix_put_raw(p, has_without ? "<th>with, dB" : "<th>PSNR, dB");
    if (has_seen) gsfix_put_raw(p, has_without ? "<th>with, seen pixels, dB" : "<th>seen pixels, dB");
    if (has_without) gsfix_put_raw(p, "<th>SSIM without");
    gsfix_put_raw(p, has_without ? "<th>with" : "<th>SSIM");
    if (r->filtered_views) gsfix_put_raw(p, "<th>PSNR filtered, dB<th>SSIM filtered");
    gsfix_put_raw(p, "</tr></thead><tbody>");
    for (size_t i = 0; i <= r->split->test_count; i++) {
        const int mean = i == r->split->test_count;
        const gsfix_score* now = mean ? &r->mean : &r->views[i];
        const gsfix_score* was = mean ? &r->without : &r->history->without[i];
        gsfix_put_raw(p, mean ? "<tr class=mean><td>mean" : "<tr><td>");
        if (!mean) gsfix_put_escaped(p, r->scene->views[r->split->test[i]].name);
        if (has_without) put_cell(p, was->psnr, 2);
        put_cell(p, now->psnr, 2);
        if (has_seen) put_cell(p, now->psnr_seen, 2);
        if (has_without) put_cell(p, was->ssim, 4);
        put_cell(p, now->ssim, 4);
        if (r->filtered_views) {
            const gsfix_score* filtered = mean ? &r->filtered : &r->filtered_views[i];
            put_cell(p, filtered->psnr, 2);
            put_cell(p, filtered->ssim, 4);
        }
        gsfix_put_raw(p, "</tr>");
    }
    gsfix_put_raw(p, "</tbody></table></div></section>\n");
}

// How a switch of metrics.json is displayed: heading, meaning of zero (or less), and unit ("<x": placed before the value).
static const struct { const char *key, *group, *zero, *unit; } switches[] = {
    {"views", "Photos", NULL, ""}, {"test_every", "Photos", "none held out", ""}, {"factor", "Photos", NULL, ""},
    {"max_size", "Photos", "no limit", " pixels"}, {"photo_masks", "Photos", NULL, ""}, {"photos_masked", "Photos", "none", ""},
    {"width", "Photos", NULL, " pixels"}, {"height", "Photos", NULL, " pixels"},
    {"train_views", "Photos", NULL, ""}, {"init", "Start", NULL, ""}, {"initial_splats", "Start", NULL, ""},
    {"random_points", "Start", NULL, ""}, {"extent", "Start", NULL, ""}, {"near_plane", "Start", NULL, ""},
    {"regularize", "Regularisers for few views", NULL, ""}, {"dropout", "Regularisers for few views", "off", ""},
    {"opacity_decay", "Regularisers for few views", "off", " per step"},
    {"scale_penalty", "Regularisers for few views", "off", ""}, {"opacity_penalty", "Regularisers for few views", "off", ""},
    {"depth_smoothness", "Regularisers for few views", "off", ""}, {"restorer", "Repair", NULL, ""}, {"compare", "Repair", NULL, ""},
    {"trajectory", "Repair", NULL, ""}, {"rounds", "Repair", "none", ""}, {"first_round", "Repair", NULL, "<step "},
    {"last_round", "Repair", NULL, "<step "}, {"windows", "Repair", NULL, " per round"},
    {"window_frames", "Repair", NULL, ""}, {"lambda", "Repair", NULL, " at the end"},
    {"skip_psnr", "Repair", "never", " dB"}, {"frame_scale", "Repair", NULL, " of a photo's sides"},
    {"warp_weight", "Repair", "no frames of warp", " of frames of warp"}, {"max_pixels", "Repair", "no limit", ""},
    {"densify_until", "Training", "never", "<step "}, {"densify_from", "Training", NULL, "<step "},
    {"densify_interval", "Training", NULL, " steps"}, {"sh_interval", "Training", NULL, " steps"},
    {"opacity_reset_interval", "Training", "never", " steps"}, {"lambda_ssim", "Training", "no SSIM term", ""},
};

static void put_number(page* p, double x) { // integers with all digits
    if (x == floor(x) && fabs(x) < 1e15) gsfix_put(p, "%.0f", x);
    else gsfix_put(p, "%.6g", x);
}

static void put_switch(page* p, const gsf_json* json, const gsf_json_value* v, const char* zero, const char* unit) {
    static const char* const meanings[][3] = {
        {"init", "both", "tracks and rays"}, {"init", "embree", "rays"}, {"init", "all", "every point"},
        {"trajectory", "reference", "photo to photo"}, {"trajectory", "interpolate", "spline"}, {"trajectory", "spread", "all around"},
        {"init", "dense", "tracks, rays and stereo"},
    };
    gsfix_put_raw(p, v->type == GSF_JSON_ARRAY && v->count > 3 ? "<div class=broad><dt>" : "<div><dt>");
    gsfix_put_escaped(p, v->key);
    gsfix_put_raw(p, "</dt><dd>");
    if (v->type == GSF_JSON_NUMBER && zero && v->number <= 0.0) gsfix_put_raw(p, zero);
    else if (v->type == GSF_JSON_NUMBER) {
        if (*unit == '<') gsfix_put_raw(p, unit + 1);
        put_number(p, v->number);
        if (*unit != '<') gsfix_put_raw(p, unit);
    } else if (v->type == GSF_JSON_STRING) {
        gsfix_put_escaped(p, v->string);
        for (size_t i = 0; i < sizeof meanings / sizeof *meanings; i++)
            if (strcmp(meanings[i][0], v->key) == 0 && strcmp(meanings[i][1], v->string) == 0) gsfix_put(p, " (%s)", meanings[i][2]);
    }
    for (uint32_t k = v->type == GSF_JSON_ARRAY ? v->child : 0; k; k = json->values[k].next) {
        if (json->values[k].string) gsfix_put_escaped(p, json->values[k].string);
        else put_number(p, json->values[k].number);
        if (json->values[k].next) gsfix_put_raw(p, ", ");
    }
    gsfix_put_raw(p, "</dd></div>");
}

static gsf_result put_switches(page* p, const char* command) {
    static const char* const groups[] = {"Photos", "Start", "Repair", "Regularisers for few views", "Training"};
    enum { GROUPS = sizeof groups / sizeof *groups, SWITCHES = sizeof switches / sizeof *switches };
    gsf_json json;
    gsf_result result = gsf_parse_json(p->ctx, "switches", p->r->switches, strlen(p->r->switches), &json);
    if (result != GSF_OK) return result;
    gsfix_put_raw(p, "<section><h2>How it was made</h2><pre>");
    gsfix_put_escaped(p, command);
    gsfix_put(p, "</pre><p>gsfixer %s, %s kernels, %d worker%s. The same command gives bit-identical results with any number of workers. "
           "PSNR and SSIM compare the render, clamped to [0,1], with the 8-bit photo; SSIM is that of the 3DGS papers (11x11 Gaussian window). "
           "The settings of the run are listed below, with their names in metrics.json.</p>", GSF_VERSION,
        gsf_describe_cpu_level(p->ctx->cpu_level), p->ctx->parallel.worker_count, p->ctx->parallel.worker_count == 1 ? "" : "s");
    for (int group = 0; group < GROUPS; group++) {
        gsfix_put(p, "<h3>%s</h3><dl class=switches>", groups[group]);
        for (uint32_t i = json.values[0].child; i; i = json.values[i].next) {
            int k = 0;
            while (k < SWITCHES && strcmp(switches[k].key, json.values[i].key) != 0) k++;
            if (strcmp(k < SWITCHES ? switches[k].group : "Training", groups[group]) != 0) continue;
            put_switch(p, &json, &json.values[i], k < SWITCHES ? switches[k].zero : NULL, k < SWITCHES ? switches[k].unit : "");
        }
        gsfix_put_raw(p, "</dl>");
    }
    gsfix_put_raw(p, "</section>\n");
    gsf_destroy_json(p->ctx, &json);
    return GSF_OK;
}

// ---- scene in three dimensions -----------------------------------------------------

typedef struct frame3 { double center[3], axes[3][3], scale; } frame3; // world -> integers, y up, cameras within +-1000

static int to_whole(double x) { return isnan(x) ? 0 : (int)(x > 1e6 ? 1e6 : x < -1e6 ? -1e6 : floor(x + 0.5)); }

static void to_view(const frame3* f, const double world[3], int out[3]) {
    for (int a = 0; a < 3; a++) {
        double sum = 0.0;
        for (int k = 0; k < 3; k++) sum += f->axes[a][k] * (world[k] - f->center[k]);
        sum *= f->scale;
        out[a] = to_whole(sum);
    }
}

static void turn_only(const frame3* f, const double direction[3], double length, int out[3]) {
    for (int a = 0; a < 3; a++)
        out[a] = to_whole(length * (f->axes[a][0] * direction[0] + f->axes[a][1] * direction[1] + f->axes[a][2] * direction[2]));
}

static void normalize(double v[3]) {
    const double length = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
    for (int k = 0; k < 3; k++) v[k] = length > 1e-12 ? v[k] / length : k == 0;
}

static frame3 make_frame(const gsf_scene* scene) {
    frame3 f = {{0}, {{0}}, 1.0};
    double up[3] = {0}, forward[3] = {0}, most = 0.0;
    for (size_t i = 0; i < scene->view_count; i++) {
        double c2w[16];
        gsf_get_camera_c2w(&scene->views[i].camera, c2w);
        for (int k = 0; k < 3; k++) {
            f.center[k] += c2w[12 + k] / (double)scene->view_count;
            up[k] -= c2w[4 + k];
            forward[k] += c2w[8 + k];
        }
    }
    normalize(up);
    const double along = forward[0] * up[0] + forward[1] * up[1] + forward[2] * up[2];
    for (int k = 0; k < 3; k++) forward[k] -= along * up[k];
    if (forward[0] * forward[0] + forward[1] * forward[1] + forward[2] * forward[2] < 1e-6) {
        const double other[3] = {fabs(up[0]) < 0.7, fabs(up[0]) >= 0.7, 0.0}; // any direction not parallel to up
        const double part = other[0] * up[0] + other[1] * up[1];
        for (int k = 0; k < 3; k++) forward[k] = other[k] - part * up[k];
    }
    normalize(forward);
    for (int k = 0; k < 3; k++) {
        f.axes[0][k] = forward[(k + 1) % 3] * up[(k + 2) % 3] - forward[(k + 2) % 3] * up[(k + 1) % 3];
        f.axes[1][k] = up[k];
        f.axes[2][k] = forward[k];
    }
    for (size_t i = 0; i < scene->view_count; i++) {
        double c[3], d = 0.0;
        gsf_get_camera_center(&scene->views[i].camera, c);
        for (int k = 0; k < 3; k++) d += (c[k] - f.center[k]) * (c[k] - f.center[k]);
        if (d > most) most = d;
    }
    f.scale = most > 0.0 ? 1000.0 / sqrt(most) : 1.0;
    return f;
}

static void put_cameras(page* p, const frame3* f, const char* key, const uint32_t* views, size_t count) {
    gsfix_put(p, "\"%s\":[", key); // centre and the four corners of the image plane
    for (size_t i = 0; i < count; i++) {
        const gsf_camera* camera = &p->r->scene->views[views[i]].camera;
        double c2w[16], center[3];
        int v[3];
        gsf_get_camera_c2w(camera, c2w);
        memcpy(center, c2w + 12, sizeof center);
        to_view(f, center, v);
        gsfix_put(p, "%s[%d,%d,%d", i ? "," : "", v[0], v[1], v[2]);
        for (int k = 0; k < 4; k++) {
            const double x = ((k == 1 || k == 2 ? camera->width : 0) - camera->cx) / camera->fx;
            const double y = ((k >= 2 ? camera->height : 0) - camera->cy) / camera->fy;
            double direction[3];
            for (int a = 0; a < 3; a++) direction[a] = c2w[a] * x + c2w[4 + a] * y + c2w[8 + a];
            turn_only(f, direction, 110.0, v);
            gsfix_put(p, ",%d,%d,%d", v[0], v[1], v[2]);
        }
        gsfix_put_raw(p, "]");
    }
    gsfix_put_raw(p, "],");
}

static void put_cloud(page* p, const frame3* f) { // coloured points of the splats that are visible enough
    const gsf_splats* s = p->r->splats;
    const size_t bands = (size_t)gsf_splat_count_sh(s->sh_degree);
    size_t solid = 0, taken = 0, shown = 0;
    const float least = -1.4f; // logit of opacity 0.2
    for (size_t i = 0; i < s->count; i++) solid += s->opacity_logits[i] > least;
    gsfix_put_raw(p, "\"cloud\":[");
    for (size_t i = 0; i < s->count; i++) {
        if (!(s->opacity_logits[i] > least)) continue;
        if (taken++ * CLOUD_POINTS / (solid + 1) < shown) continue; // evenly spaced sample
        shown++;
        double world[3];
        int v[3], c[3];
        for (size_t k = 0; k < 3; k++) {
            world[k] = s->origin[k] + (double)s->means[3 * i + k];
            const double color = 0.5 + 0.28209479177387814 * (double)s->sh[3 * bands * i + k];
            c[k] = (int)(255.0 * (color > 0.0 ? color < 1.0 ? color : 1.0 : 0.0) + 0.5);
        }
        to_view(f, world, v);
        if (abs(v[0]) < 6000 && abs(v[1]) < 6000 && abs(v[2]) < 6000)
            gsfix_put(p, "%d,%d,%d,%d,", v[0], v[1], v[2], c[0] << 16 | c[1] << 8 | c[2]);
    }
    gsfix_put_raw(p, "0],");
}

static void put_scene(page* p) {
    const gsfix_result* r = p->r;
    const gsfix_history* h = r->history;
    const frame3 f = make_frame(r->scene);
    gsfix_put_raw(p, "<section><h2>Cameras and path</h2><p>Drag to rotate, use the buttons to zoom.</p>\n<div class=stage3>"
               "<canvas id=space aria-label=\"cameras, path and splats in three dimensions\"></canvas>"
               "<div class=zoom><button data-z=1.25 aria-label=closer>+</button><button data-z=0.8 aria-label=farther>&minus;</button></div></div>"
               "<p class=keys><span><i class=k-train></i>training photos</span><span><i class=k-test></i>held-out photos</span>");
    for (size_t i = 0; i < h->round_count && h->path_count; i++)
        gsfix_put(p, "<span><i class=\"k-path\" style=\"background:hsl(%d 85%% 72%%)\"></i>path of round %d</span>", 225 + 50 * (int)i, (int)h->rounds[i].round);
    gsfix_put_raw(p, "</p>\n<script type=\"application/json\" id=scene>{");
    put_cameras(p, &f, "train", r->split->train, r->split->train_count);
    put_cameras(p, &f, "test", r->split->test, r->split->test_count);
    put_cloud(p, &f);
    gsfix_put_raw(p, "\"paths\":[");
    for (size_t i = 0, open = 0; i < h->path_count; i++) {
        int v[3];
        const int fresh = i == 0 || h->path[i].round != h->path[i - 1].round || h->path[i].window != h->path[i - 1].window;
        to_view(&f, h->path[i].center, v);
        if (fresh) gsfix_put(p, "%s{\"round\":%d,\"at\":[", open ? "]}," : "", (int)h->path[i].round);
        gsfix_put(p, "%s%d,%d,%d", fresh ? "" : ",", v[0], v[1], v[2]);
        open = 1;
    }
    gsfix_put_raw(p, h->path_count ? "]}]}" : "]}");
    gsfix_put_raw(p, "</script></section>\n");
}

// ---- page ------------------------------------------------------------------------

static const char* const style[] = { // in pieces, since C guarantees string literals of up to 4095 characters only
    ":root{--bg:#fbfaf8;--card:#fff;--ink:#1d1c1a;--soft:#6b6862;--line:#e4e1da;--accent:#0d7a6f;--warm:#c2570c;--good:#15803d;--bad:#b91c1c}",
    "@media(prefers-color-scheme:dark){:root{--bg:#161614;--card:#201f1d;--ink:#eceae4;--soft:#a09c93;--line:#35332f;--accent:#35b8a8;",
    "--warm:#f09149;--good:#4cc274;--bad:#f07575}}",
    "*{box-sizing:border-box}html{color-scheme:light dark}",
    "body{margin:0 auto;max-width:1120px;padding:28px 20px 60px;background:var(--bg);color:var(--ink);",
    "font:16px/1.5 system-ui,-apple-system,'Segoe UI',Roboto,'DejaVu Sans',sans-serif}",
    "h1{font-size:clamp(26px,5vw,40px);line-height:1.15;margin:.1em 0 .3em;overflow-wrap:anywhere}",
    "h2{font-size:21px;margin:0 0 6px}section{margin:44px 0 0}p{margin:.3em 0 .8em;max-width:74ch;color:var(--soft)}",
    ".eyebrow{color:var(--accent);font-weight:600;letter-spacing:.06em;text-transform:uppercase;font-size:12.5px;margin:0}",
    ".lede{font-size:18px;color:var(--ink)}.small{font-size:14px}em{font-style:normal;font-weight:600;color:var(--ink)}",
    ".tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(145px,1fr));gap:12px;margin:22px 0 0}",
    ".tile{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:12px 14px}",
    ".tile dt{font-size:13px;color:var(--soft)}.tile dd{margin:2px 0 0;font-size:27px;font-weight:650;line-height:1.2;font-variant-numeric:tabular-nums}",
    ".tile small{font-size:15px;font-weight:500;color:var(--soft)}.tile p{margin:2px 0 0;font-size:13px}",
    ".tile .up{color:var(--good)}.tile .down{color:var(--bad)}",
    ".cards{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,320px),1fr));gap:16px;margin-top:14px}",
    ".card{margin:0;background:var(--card);border:1px solid var(--line);border-radius:10px;overflow:hidden}",
    ".cards.broad{grid-template-columns:repeat(auto-fill,minmax(min(100%,480px),1fr))}.triple>div{display:grid;grid-template-columns:repeat(3,1fr);gap:2px}",
    "figcaption{display:flex;flex-wrap:wrap;gap:2px 14px;padding:8px 12px;font-size:14px;color:var(--soft);font-variant-numeric:tabular-nums}",
    ".triple figcaption strong{flex-basis:auto}figcaption strong{color:var(--ink);flex-basis:100%;overflow-wrap:anywhere}figcaption b{color:var(--ink)}",
    ".cmp{position:relative;--x:50%;width:100%;background:#000;overflow:hidden;touch-action:pan-y}",
    ".cmp img,.still img{display:block;width:100%;height:auto}.still{position:relative}",
    ".pane{position:absolute;inset:0;display:none}.pane.left{display:block;z-index:2;clip-path:inset(0 calc(100% - var(--x)) 0 0)}",
    ".pane.right{display:block;z-index:1}.pane span,.still span{position:absolute;bottom:8px;background:rgba(0,0,0,.62);color:#fff;",
    "font-size:12px;padding:1px 7px;border-radius:99px}.pane.left span,.still span{left:8px}.pane.right span{right:8px}",
    ".cmp .bar{position:absolute;z-index:3;top:0;bottom:0;left:var(--x);width:2px;margin-left:-1px;background:#fff;box-shadow:0 0 4px rgba(0,0,0,.6)}",
    ".cmp .bar::after{content:'\\2194';position:absolute;top:50%;left:50%;transform:translate(-50%,-50%);width:30px;height:30px;border-radius:50%;",
    "background:#fff;color:#222;font:17px/30px sans-serif;text-align:center;box-shadow:0 1px 5px rgba(0,0,0,.45)}",
    ".cmp input{position:absolute;z-index:4;inset:0;width:100%;height:100%;margin:0;opacity:0;cursor:ew-resize}",
    ".cmp:focus-within{outline:3px solid var(--accent)}",
    ".choice{display:flex;flex-wrap:wrap;gap:8px;margin:10px 0}button{font:inherit;font-size:14px;padding:5px 13px;border:1px solid var(--line);",
    "border-radius:99px;background:var(--card);color:var(--ink);cursor:pointer}button.on{background:var(--accent);border-color:var(--accent);color:#fff}",
    ".legend{display:none;align-items:center;flex-wrap:wrap;gap:4px 8px;font-size:13px;color:var(--soft)}.legend i{width:180px;height:12px;border-radius:3px}",
    ".legend.on{display:flex}",
    ".chart{width:100%;max-width:820px;display:block}.chart text{font-size:12px;fill:var(--soft)}.chart .grid{stroke:var(--line)}",
    ".chart .round{stroke:var(--soft);stroke-dasharray:4 4}.chart text.round{stroke:none}",
    ".chart polyline{fill:none;stroke-width:2.4;stroke:var(--accent)}.chart circle{fill:var(--accent)}",
    ".chart polyline.seen{stroke:var(--warm);stroke-dasharray:6 4}.chart circle.seen{fill:var(--warm)}",
    ".chart .without,.keys i.without{opacity:0.45}",
    ".keys{display:flex;flex-wrap:wrap;gap:4px 18px;font-size:14px}.keys i{display:inline-block;width:18px;height:4px;border-radius:2px;",
    "vertical-align:middle;margin-right:6px;background:var(--accent)}.keys i.seen{background:var(--warm)}.keys i.k-train{background:#2dd4bf}.keys i.k-test{background:#fb923c}",
    ".stage3{position:relative;background:var(--card);border:1px solid var(--line);border-radius:10px;overflow:hidden}",
    "canvas{display:block;background:#17181c;width:100%;height:min(60vh,480px);cursor:grab;touch-action:pan-y}.zoom{position:absolute;right:10px;top:10px;display:flex;gap:6px}",
    ".zoom button{width:34px;height:34px;padding:0;font-size:18px}",
    ".stages{display:flex;height:26px;border-radius:6px;overflow:hidden;gap:1px;margin:12px 0}.stages i{min-width:2px;flex-basis:0}",
    ".s0{background:#8b93a5}.s1{background:#0d7a6f}.s2{background:#4f83cc}.s3{background:#c2570c}.s4{background:#6aa84f}.s5{background:#c9a227}.s6{background:#a3788f}.s7{background:#5a6b8c}.s8{background:#2f9aa8}",
    ".dot{display:inline-block;width:11px;height:11px;border-radius:3px;margin-right:8px}",
    "table{border-collapse:collapse;font-size:14.5px;font-variant-numeric:tabular-nums}td,th{padding:4px 16px 4px 0;text-align:left;vertical-align:top}",
    "th{font-weight:600;color:var(--soft);border-bottom:1px solid var(--line)}th+th,td.num{text-align:right}.mean td{border-top:1px solid var(--line);font-weight:650}",
    ".wide{color:var(--soft)}.scroll{overflow-x:auto}",
    "pre{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:12px;white-space:pre-wrap;overflow-wrap:anywhere;font-size:13.5px;margin:8px 0}",
    ".switches{display:grid;grid-template-columns:repeat(auto-fill,minmax(230px,1fr));gap:0 26px;font-size:13.5px;margin:0}",
    ".switches div{display:flex;justify-content:space-between;gap:14px;border-bottom:1px solid var(--line);padding:3px 0}",
    ".switches .broad{grid-column:1/-1}h3{font-size:14px;margin:16px 0 2px}",
    ".switches dt{color:var(--soft)}.switches dd{margin:0;text-align:right;overflow-wrap:anywhere}",
    "@media(max-width:560px){.wide{display:none}body{padding:18px 14px 40px}.tile dd{font-size:22px}}",
    "@media print{:root{--bg:#fff;--card:#fff;--ink:#000;--soft:#444;--line:#ccc}body{max-width:none;padding:0;font-size:12px}",
    ".choice,.zoom,.cmp .bar,.cmp input{display:none}.legend{display:flex}.cards{grid-template-columns:1fr}.card,.tile{break-inside:avoid}",
    ".cmp{aspect-ratio:auto!important;display:grid;grid-template-columns:repeat(5,1fr);gap:2px;background:none}",
    ".pane,.pane.left,.pane.right{position:relative;display:block;clip-path:none;order:0}.pane span,.pane.left span,.pane.right span{left:6px;right:auto}",
    "section{margin-top:22px}h2,h2+p{break-after:avoid}.cards.broad{grid-template-columns:1fr 1fr}svg,.stage3{break-inside:avoid}*{-webkit-print-color-adjust:exact;print-color-adjust:exact}}",
    NULL};

static const char* const script[] = { // in pieces, since C guarantees string literals of up to 4095 characters only
    "(function(){'use strict';var all=function(q){return Array.prototype.slice.call(document.querySelectorAll(q))};\n",
    "all('.cmp input').forEach(function(i){var f=function(){i.parentNode.style.setProperty('--x',i.value/10+'%')};i.addEventListener('input',f);f()});\n",
    "all('.choice button').forEach(function(b){b.addEventListener('click',function(){\n",
    " all('.choice button').forEach(function(o){o.className=o===b?'on':''});\n",
    " all('.pane').forEach(function(p){p.className='pane'+(p.dataset.k===b.dataset.l?' left':p.dataset.k===b.dataset.r?' right':'')});\n",
    " all('.legend').forEach(function(l){l.className='legend'+(/error/.test(b.dataset.l+b.dataset.r)?' on':'')})})});\n",
    "var c=document.getElementById('space');if(!c)return;var d=JSON.parse(document.getElementById('scene').textContent),g=c.getContext('2d');\n",
    "var yaw=-0.6,pitch=0.55,zoom=1,mid=[0,0,0],n=0;\n",
    "var focus=function(){var s=[[],[],[]];for(var i=0;i+3<d.cloud.length;i+=4)for(var k=0;k<3;k++)s[k].push(d.cloud[i+k]);\n",
    " for(k=0;k<3;k++){s[k].sort(function(a,b){return a-b});if(s[k].length)mid[k]=s[k][s[k].length>>1]*0.5}};focus();\n",
    "function draw(){n=0;var w=c.clientWidth,h=c.clientHeight,r=window.devicePixelRatio||1;if(c.width!==Math.round(w*r)||c.height!==Math.round(h*r)){c.width=Math.round(w*r);c.height=Math.round(h*r)}\n",
    " g.setTransform(r,0,0,r,0,0);g.clearRect(0,0,w,h);var cy=Math.cos(yaw),sy=Math.sin(yaw),cp=Math.cos(pitch),sp=Math.sin(pitch),s=Math.min(w,h)*zoom;\n",
    " function at(x,y,z){x-=mid[0];y-=mid[1];z-=mid[2];var a=cy*x+sy*z,b=-sy*x+cy*z,u=cp*y-sp*b,q=sp*y+cp*b,k=s/(5200+q);return k>0&&5200+q>200?[w/2+1.9*a*k,h/2-1.9*u*k,5200+q]:null}\n",
    " var dots=[];for(var i=0;i+3<d.cloud.length;i+=4){var p=at(d.cloud[i],d.cloud[i+1],d.cloud[i+2]);if(p){p.push(d.cloud[i+3]);dots.push(p)}}\n",
    " dots.sort(function(a,b){return b[2]-a[2]});dots.forEach(function(p){g.fillStyle='#'+('000000'+p[3].toString(16)).slice(-6);var e=Math.max(1.5,11000*zoom/p[2]);g.fillRect(p[0]-e/2,p[1]-e/2,e,e)});\n",
    " d.paths.forEach(function(l){g.strokeStyle='hsl('+(225+50*(l.round-1))+' 85% 72%)';g.lineWidth=2;g.beginPath();var on=0;for(var i=0;i<l.at.length;i+=3){var p=at(l.at[i],l.at[i+1],l.at[i+2]);if(p){on?g.lineTo(p[0],p[1]):g.moveTo(p[0],p[1]);on=1}}g.stroke()});\n",
    " function cams(list,color,width){g.strokeStyle=color;g.fillStyle=color;g.lineWidth=width;list.forEach(function(v){var o=at(v[0],v[1],v[2]);if(!o)return;var k=[],i;\n",
    "  for(i=3;i<15;i+=3){var q=at(v[0]+v[i],v[1]+v[i+1],v[2]+v[i+2]);if(!q)return;k.push(q)}\n",
    "  g.beginPath();for(i=0;i<4;i++){g.moveTo(o[0],o[1]);g.lineTo(k[i][0],k[i][1]);g.lineTo(k[(i+1)%4][0],k[(i+1)%4][1])}g.stroke();g.beginPath();g.arc(o[0],o[1],2.6,0,7);g.fill()})}\n",
    " cams(d.test,'#fb923c',1.3);cams(d.train,'#2dd4bf',1.9)}\n",
    "function later(){if(!n)n=requestAnimationFrame(draw)}\n",
    "var px,py,down=0;c.addEventListener('pointerdown',function(e){down=1;px=e.clientX;py=e.clientY;c.setPointerCapture(e.pointerId)});\n",
    "c.addEventListener('pointermove',function(e){if(!down)return;yaw+=(e.clientX-px)*0.008;pitch=Math.max(-1.5,Math.min(1.5,pitch+(e.clientY-py)*0.008));px=e.clientX;py=e.clientY;later()});\n",
    "['pointerup','pointercancel'].forEach(function(t){c.addEventListener(t,function(){down=0})});\n",
    "all('.zoom button').forEach(function(b){b.addEventListener('click',function(){zoom=Math.max(0.2,Math.min(12,zoom*b.dataset.z));later()})});\n",
    "window.addEventListener('resize',later);window.addEventListener('beforeprint',draw);draw()})();",
    NULL};

void gsfix_put_head(page* p, const char* title) {
    gsfix_put_raw(p, "<!doctype html>\n<html lang=en><head><meta charset=utf-8><meta name=viewport content=\"width=device-width,initial-scale=1\">"
                     "<meta name=generator content=\"gsfix " GSF_VERSION "\"><title>");
    gsfix_put_escaped(p, title);
    gsfix_put_raw(p, "</title><style>");
    gsfix_put_lines(p, style);
    gsfix_put_raw(p, "</style></head><body>\n");
}

static void put_header(page* p) {
    const gsfix_result* r = p->r;
    const gsfix_history* h = r->history;
    const char* folder = r->scene->folder ? r->scene->folder : "scene";
    gsfix_path name = gsfix_pathf("%s", folder);
    for (size_t n = strlen(name.s); n > 1 && (name.s[n - 1] == '/' || name.s[n - 1] == '.'); n--) name.s[n - 1] = 0;
    const char* title = strrchr(name.s, '/') && strrchr(name.s, '/')[1] ? strrchr(name.s, '/') + 1 : name.s;
    gsfix_put_head(p, gsfix_pathf("gsfixer: %s", title).s);
    gsfix_put_raw(p, "<p class=eyebrow>gsfixer report</p><h1>");
    gsfix_put_escaped(p, title);
    gsfix_put(p, "</h1><p class=lede>A 3D Gaussian Splatting scene from %zu photo%s, trained for %d steps", r->split->train_count,
        r->split->train_count == 1 ? "" : "s", (int)r->iterations);
    if (h->round_count) gsfix_put(p, " with %zu round%s of repair", h->round_count, h->round_count == 1 ? "" : "s");
    if (r->copies > 1) gsfix_put(p, ", in %zu copies that were joined", r->copies);
    if (r->split->test_count) gsfix_put(p, ". The quality is measured on %zu photos that were not used for training", r->split->test_count);
    gsfix_put_raw(p, ".</p>\n");
}

gsf_result gsfix_write_report(gsfix_app* app, const gsfix_result* result_) {
    page p = {&app->ctx, result_, {0}};
    put_header(&p);
    put_tiles(&p);
    gsf_result result = put_views(&p);
    put_curve(&p);
    if (result == GSF_OK) result = put_samples(&p);
    put_scene(&p);
    put_seconds(&p);
    put_table(&p);
    if (result == GSF_OK) result = put_switches(&p, app->command_line);
    gsfix_put_raw(&p, "<script>");
    gsfix_put_lines(&p, script);
    gsfix_put_raw(&p, "</script></body></html>\n");
    if (result == GSF_OK)
        result = p.html.failed ? GSF_ERROR_OUT_OF_MEMORY
                               : gsf_write_file(&app->ctx, gsfix_pathf("%s/report.html", result_->out).s, p.html.data, p.html.size);
    gsf_destroy_buffer(&app->ctx, &p.html);
    return result;
}
