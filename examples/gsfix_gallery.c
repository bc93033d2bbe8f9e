// gsfix_gallery.c - OUT/gallery.html of gsfix evaluate: sequences side by side, self-contained; it makes no network requests
// SPDX-License-Identifier: MIT
#include "gsfix_evaluate.h"

#include <math.h>

/* A group shows one scene in one setting: the photo and what each method makes of it, frame by frame, of the first seed and
   the first start. Its pictures are sets of JPEGs in a JSON object; the script plays all groups in step, draws the comparison
   with its divider, and computes the error maps. Photos are stored once per scene. */
enum {
    GALLERY_SIDE = 320,     // longer side of a picture, pixels
    GALLERY_PICTURES = 800, // of all groups; scenes are left out and frames thinned out to keep to it
    GALLERY_SCENES = 8, GALLERY_FEWEST = 6, // scenes shown at most; frames per set at least while scenes can be left out
};

typedef struct gallery {
    gsfix_app* app;
    gsf_context* ctx;
    const eval_plan* plan;
    gsfix_page page;
    size_t sets, groups; // written so far
    int frames;          // per set at most
    gsf_buffer list;     // the groups, which follow the sets
} gallery;

static size_t thin_out(size_t i, size_t shown, size_t count) { // index of the shown frame i, first and last included
    return shown > 1 ? (i * (count - 1) + (shown - 1) / 2) / (shown - 1) : 0;
}

static void begin_set(gallery* g) { gsfix_put_raw(&g->page, g->sets++ ? ",\n[" : "\n["); }

static gsf_result put_frame(gallery* g, const gsf_image* image, int first, int64_t* width, int64_t* height) {
    gsfix_put_raw(&g->page, first ? "\"" : ",\"");
    const gsf_result result = gsfix_put_jpeg(&g->page, image, GALLERY_SIDE, width, height);
    gsfix_put_raw(&g->page, "\"");
    return result;
}

static gsf_result put_file(gallery* g, gsfix_path path, int first) {
    gsf_image image = {0};
    int64_t width, height;
    gsf_result result = gsf_load_image(g->ctx, path.s, 3, &image);
    if (result == GSF_OK) result = put_frame(g, &image, first, &width, &height);
    gsf_destroy_image(g->ctx, &image);
    return result;
}

// ---- groups ------------------------------------------------------------------------------

typedef struct gallery_group {
    const char* scene;
    gsfix_path title;
    gsfix_path names[EVAL_LIST + 2], notes[EVAL_LIST + 2];
    size_t sets[EVAL_LIST + 2];
    int count;             // of sets; the first one has the photos
    size_t frames;
    const uint8_t* photos; // per frame: what the photo was for; 1: trained on, 2: held out, 0: neither
    int64_t width, height;
} gallery_group;

// run NULL: the photos.
static void add_set(gallery* g, gallery_group* group, const eval_run* run) {
    char name[96] = "photo";
    if (run) eval_name_arm(&g->plan->arms[run->arm], run->kind, name, sizeof name);
    group->names[group->count] = gsfix_pathf("%s", name);
    group->notes[group->count] = gsfix_pathf("%s", "");
    if (run && !isnan(run->scores[0]))
        group->notes[group->count] = gsfix_pathf("%.2f dB, SSIM %.3f", run->scores[0], run->scores[1]);
    group->sets[group->count++] = g->sets;
}

static void put_group(gallery* g, const gallery_group* group) { // after its sets
    gsf_context* ctx = g->ctx;
    gsf_buffer* t = &g->list;
    gsfix_json_begin(ctx, t, NULL, '{');
    gsfix_json_text(ctx, t, "scene", group->scene);
    gsfix_json_text(ctx, t, "title", group->title.s);
    gsfix_json_number(ctx, t, "w", (double)group->width);
    gsfix_json_number(ctx, t, "h", (double)group->height);
    gsfix_json_begin(ctx, t, "sets", '[');
    for (int i = 0; i < group->count; i++) {
        gsfix_json_begin(ctx, t, NULL, '{');
        gsfix_json_text(ctx, t, "name", group->names[i].s);
        gsfix_json_text(ctx, t, "note", group->notes[i].s);
        gsfix_json_number(ctx, t, "set", (double)group->sets[i]);
        gsfix_json_end(ctx, t, '}');
    }
    gsfix_json_end(ctx, t, ']');
    gsfix_json_begin(ctx, t, "photos", '[');
    for (size_t i = 0; i < group->frames; i++) gsfix_json_number(ctx, t, NULL, group->photos[i]);
    gsfix_json_end(ctx, t, ']');
    gsfix_json_end(ctx, t, '}');
    g->groups++;
}

// ---- reconstruction ------------------------------------------------------------------------

// The photos of the views that eval_save_pictures has rendered.
static gsf_result put_photos(gallery* g, gsf_scene* scene, const uint32_t* views, size_t count, gallery_group* group) {
    const size_t shown = count < (size_t)g->frames ? count : (size_t)g->frames;
    gsf_result result = GSF_OK;
    add_set(g, group, NULL);
    begin_set(g);
    for (size_t i = 0; i < shown && result == GSF_OK; i++) {
        const size_t view = views[thin_out(i, shown, count)];
        int64_t width = 0, height = 0;
        result = gsf_splat_load_view_image(g->ctx, scene, view);
        if (result == GSF_OK) result = put_frame(g, &scene->views[view].image, i == 0, &width, &height);
        if (i == 0) group->width = width, group->height = height;
        gsf_destroy_image(g->ctx, &scene->views[view].image);
        gsf_destroy_image(g->ctx, &scene->views[view].weight);
    }
    group->frames = shown;
    gsfix_put_raw(&g->page, "]");
    return result;
}

static gsf_result put_method(gallery* g, gallery_group* group, const eval_run* run, size_t count) {
    gsf_result result = GSF_OK;
    add_set(g, group, run);
    begin_set(g);
    for (size_t i = 0; i < group->frames && result == GSF_OK; i++)
        result = put_file(g, gsfix_pathf("%s/%s/pictures/%02zu.jpg", g->app->o.out, g->plan->names[run - g->plan->runs],
                                         thin_out(i, group->frames, count)), i == 0);
    gsfix_put_raw(&g->page, "]");
    return result;
}

static gsf_result mark_photos(gallery* g, const gsf_scene* scene, int views, const uint32_t* frames, size_t count, size_t shown,
                              uint8_t* photos) {
    const gsfix_options before = g->app->o;
    const gsfix_path text = gsfix_pathf("%d", views);
    gsfix_split split;
    g->app->o.views = text.s;
    const gsf_result result = gsfix_split_scene(g->app, scene, &split);
    g->app->o = before;
    if (result != GSF_OK) return result;
    for (size_t i = 0; i < shown; i++) {
        const uint32_t view = frames[thin_out(i, shown, count)];
        photos[i] = 0;
        for (size_t k = 0; k < split.train_count; k++)
            if (split.train[k] == view) photos[i] = 1;
        for (size_t k = 0; k < split.test_count; k++)
            if (split.test[k] == view) photos[i] = 2;
    }
    gsfix_free_split(g->app, &split);
    return GSF_OK;
}

static gsf_result put_reconstructions(gallery* g, int index) {
    static const gallery_group zero;
    const eval_plan* plan = g->plan;
    uint32_t views[EVAL_PICTURES];
    uint8_t photos[EVAL_PICTURES];
    gallery_group common = zero;
    gsf_scene scene = {0};
    size_t count = 0;
    int any = 0;
    for (size_t i = 0; i < plan->run_count; i++)
        any |= plan->runs[i].kind == EVAL_RECONSTRUCTION && plan->runs[i].scene == index && plan->runs[i].done;
    if (!any) return GSF_OK;
    gsf_result result = gsfix_load_scene(g->app, plan->given.inputs[index], &scene);
    if (result != GSF_OK) return result;
    const size_t most = scene.view_count < EVAL_PICTURES ? scene.view_count : EVAL_PICTURES;
    gsf_splat_split_views(scene.view_count, 0, most, views, &count, NULL, NULL);
    common.scene = plan->scenes[index];
    common.photos = photos;
    result = put_photos(g, &scene, views, count, &common);
    for (int k = 0; k < plan->view_counts && result == GSF_OK; k++) {
        gallery_group group = common;
        group.title = gsfix_pathf("reconstruction from %d photos", plan->views[k]);
        result = mark_photos(g, &scene, plan->views[k], views, count, group.frames, photos);
        for (int arm = 0; arm < plan->arm_count && result == GSF_OK; arm++) {
            const int repairs = plan->arms[arm].restorer != NULL;
            const int dit = repairs && strncmp(plan->arms[arm].restorer, "dit:", 4) == 0;
            const eval_run like = {EVAL_RECONSTRUCTION, 0, plan->views[k], 0, 0, arm, repairs ? plan->main_trajectory : -1,
                                   dit ? plan->main_condition : -1, 0, {0}};
            const eval_run* run = eval_find(plan, &like, index, 0);
            if (run && run->done) result = put_method(g, &group, run, count);
        }
        if (result == GSF_OK && group.count > 1) put_group(g, &group);
    }
    gsf_splat_destroy_scene(g->ctx, &scene);
    return result;
}

// ---- restoration -----------------------------------------------------------------------------

// All sequences of a scene one after the other; the reference between two of them is shown once.
static gsf_result put_sequences(gallery* g, gallery_group* group, const eval_sequences* s, const eval_run* run, int file,
                                uint8_t* photos) {
    gsf_result result = GSF_OK;
    size_t total = 1;
    for (size_t i = 0; i < s->count; i++) total += s->items[i].frame_count - 1;
    group->frames = total < (size_t)g->frames ? total : (size_t)g->frames;
    add_set(g, group, run);
    begin_set(g);
    for (size_t shown = 0; shown < group->frames && result == GSF_OK; shown++) {
        size_t at = thin_out(shown, group->frames, total), i = 0;
        while (i + 1 < s->count && at >= s->items[i].frame_count - 1) at -= s->items[i++].frame_count - 1;
        const gsfix_sequence_frame* frame = &s->items[i].frames[at];
        photos[shown] = (uint8_t)frame->reference;
        result = put_file(g, file >= 0 ? gsfix_pathf("%s/%s", s->folder.s, frame->files[file])
                                       : gsfix_pathf("%s/%s/%s", g->app->o.out, g->plan->names[run - g->plan->runs],
                                                     eval_frame_name(i, frame).s), shown == 0);
    }
    gsfix_put_raw(&g->page, "]");
    return result;
}

static gsf_result put_restorations(gallery* g, int index) {
    static const gallery_group zero;
    const eval_plan* plan = g->plan;
    uint8_t photos[EVAL_PICTURES];
    gallery_group group = zero;
    eval_run like = {EVAL_RESTORATION, index, plan->views[0], 0, -1, plan->artifacts, -1, -1, 0, {0}};
    const eval_run* artifacts = eval_find(plan, &like, index, 0);
    eval_sequences s;
    if (!artifacts || !artifacts->done) return GSF_OK;
    gsf_result result = eval_load_sequences(g->ctx, eval_artifacts_folder(plan, artifacts), &s);
    group.scene = plan->scenes[index];
    group.photos = photos;
    group.title = gsfix_pathf("restoration of a sequence, %d photos", plan->views[0]);
    if (result == GSF_OK) result = put_sequences(g, &group, &s, NULL, GSFIX_CLEAN, photos);
    if (result == GSF_OK) result = put_sequences(g, &group, &s, artifacts, GSFIX_ARTIFACT, photos);
    if (result == GSF_OK) {
        const double shrink = s.items[0].width > s.items[0].height ? GALLERY_SIDE / (double)s.items[0].width
                                                                    : GALLERY_SIDE / (double)s.items[0].height;
        group.width = (int64_t)(s.items[0].width * (shrink < 1.0 ? shrink : 1.0) + 0.5);
        group.height = (int64_t)(s.items[0].height * (shrink < 1.0 ? shrink : 1.0) + 0.5);
    }
    for (int arm = 0; arm < plan->arm_count && result == GSF_OK; arm++) {
        if (!plan->arms[arm].restorer) continue;
        like.arm = arm;
        like.condition = strncmp(plan->arms[arm].restorer, "dit:", 4) == 0 ? plan->main_condition : -1;
        const eval_run* run = eval_find(plan, &like, index, 0);
        if (run && run->done) result = put_sequences(g, &group, &s, run, -1, photos);
    }
    if (result == GSF_OK) put_group(g, &group);
    eval_free_sequences(g->ctx, &s);
    return result;
}

// ---- page ------------------------------------------------------------------------------------

static const char* const gallery_style[] = {
    "<style>body{max-width:1240px}.tool{position:sticky;top:0;z-index:9;display:flex;flex-wrap:wrap;align-items:center;gap:8px 14px;",
    "background:var(--bg);border-bottom:1px solid var(--line);padding:10px 0;margin-top:14px}.tool input{flex:1 1 220px;",
    "accent-color:var(--accent)}.tool output{font-variant-numeric:tabular-nums;color:var(--soft);min-width:5em}",
    ".pair{display:flex;gap:8px}.group{display:grid;grid-template-columns:var(--columns,minmax(0,5fr) minmax(0,4fr));gap:14px;align-items:start}",
    ".big{position:relative;background:#000;border-radius:10px;overflow:hidden}.big canvas{height:auto;background:#000;cursor:ew-resize}",
    ".big input{position:absolute;inset:0;width:100%;height:100%;margin:0;opacity:0;cursor:ew-resize}",
    ".big:focus-within{outline:3px solid var(--accent)}",
    ".strip{display:grid;grid-template-columns:repeat(auto-fill,minmax(150px,1fr));gap:10px}.strip figure{margin:0}",
    ".strip canvas{height:auto;border-radius:6px;cursor:default}.strip figcaption{padding:3px 2px;gap:0 8px}",
    ".strip figcaption strong{flex-basis:auto}.pick{display:flex;flex-wrap:wrap;gap:6px 14px;margin:8px 0 0;font-size:14px;",
    "color:var(--soft)}select{font:inherit;font-size:14px;background:var(--card);color:var(--ink);border:1px solid var(--line);",
    "border-radius:6px;padding:2px 6px}.badge{margin-left:auto}section h2{margin-bottom:8px}section h2 small{font-weight:400;",
    "color:var(--soft);font-size:16px;margin-left:8px}@media(max-width:760px){.group{grid-template-columns:1fr}}</style>\n",
    NULL};

static const char* const gallery_script[] = { // in pieces, since C guarantees string literals of up to 4095 characters only
    "(function(){'use strict';var d=JSON.parse(document.getElementById('data').textContent),body=document.getElementById('groups');\n",
    "var at=0,playing=!matchMedia('(prefers-reduced-motion: reduce)').matches,errors=false,last=0,groups=[];\n",
    "function make(tag,parent,text){var e=document.createElement(tag);if(text)e.textContent=text;if(parent)parent.appendChild(e);return e}\n",
    "function picture(set,i){var l=d.cache[set]||(d.cache[set]=[]);if(!l[i]){l[i]=new Image();l[i].onload=later;\n",
    " l[i].src='data:image/jpeg;base64,'+d.sets[set][i]}return l[i].complete&&l[i].naturalWidth?l[i]:null}\n",
    "d.cache=[];\n",
    // An error map: mean absolute difference of the colours from the photo's, on the scale that C has written.
    "function pixels(g,image){var c=make('canvas');c.width=g.w;c.height=g.h;var x=c.getContext('2d',{willReadFrequently:true});\n",
    " x.drawImage(image,0,0,g.w,g.h);return x.getImageData(0,0,g.w,g.h)}\n",
    "function shown(g,k,i){var p=picture(g.sets[k].set,i);if(!p||!errors||k===0)return p;\n",
    " var key=g.sets[k].set+':'+i;if(g.maps[key])return g.maps[key];var photo=picture(g.sets[0].set,i);if(!photo)return null;\n",
    " var a=pixels(g,p),b=pixels(g,photo),n=a.data.length,c=make('canvas');c.width=g.w;c.height=g.h;\n",
    " for(var j=0;j<n;j+=4){var e=(Math.abs(a.data[j]-b.data[j])+Math.abs(a.data[j+1]-b.data[j+1])+Math.abs(a.data[j+2]-b.data[j+2]))/765;\n",
    "  var m=3*Math.min(255,Math.round(255*e/d.white));a.data[j]=d.colors[m];a.data[j+1]=d.colors[m+1];a.data[j+2]=d.colors[m+2]}\n",
    " c.getContext('2d').putImageData(a,0,0);return g.maps[key]=c}\n",
    "function draw(g){var i=Math.round(at*(g.photos.length-1)),x=g.big.getContext('2d'),w=g.big.width,h=g.big.height,s=g.split.value/1000*w;\n",
    " g.small.forEach(function(c,k){var p=shown(g,k,i);if(p)c.getContext('2d').drawImage(p,0,0,c.width,c.height)});\n",
    " var l=shown(g,+g.left.value,i),r=shown(g,+g.right.value,i);if(r)x.drawImage(r,0,0,w,h);\n",
    " if(l){x.save();x.beginPath();x.rect(0,0,s,h);x.clip();x.drawImage(l,0,0,w,h);x.restore()}\n",
    " x.fillStyle='#fff';x.fillRect(s-1.5,0,3,h);x.beginPath();x.arc(s,h/2,22,0,7);x.fill();x.fillStyle='#222';x.font='26px sans-serif';\n",
    " x.textAlign='center';x.textBaseline='middle';x.fillText('\\u2194',s,h/2+1);\n",
    " x.font='600 20px system-ui,sans-serif';x.textBaseline='bottom';tag(x,g.sets[+g.left.value].name,12,h-12,'left');\n",
    " tag(x,g.sets[+g.right.value].name,w-12,h-12,'right');\n",
    " g.badge.textContent='frame '+(i+1)+' of '+g.photos.length+['',', trained on this photo',', photo held out'][g.photos[i]]}\n",
    "function tag(x,text,at,y,side){var w=x.measureText(text).width+20;x.fillStyle='rgba(0,0,0,.62)';x.fillRect(side==='left'?at:at-w,y-30,w,30);\n",
    " x.fillStyle='#fff';x.textAlign='center';x.fillText(text,side==='left'?at+w/2:at-w/2,y-4)}\n",
    "var due=0;function later(){if(!due)due=requestAnimationFrame(function(){due=0;groups.forEach(function(g){if(g.visible)draw(g)})})}\n",
    "d.groups.forEach(function(g){var s=make('section',body),h=make('h2',s,g.scene);make('small',h,g.title);var row=make('div',s);row.className='group';\n",
    " var one=make('div',row),big=make('div',one);big.className='big';g.big=make('canvas',big);var tall=g.h>g.w,z=tall?768/g.h:960/g.w;\n",
    " g.big.width=Math.round(g.w*z);g.big.height=Math.round(g.h*z);g.big.style.width='100%';\n",
    " if(tall){var most=Math.round(520*g.w/g.h);big.style.maxWidth=most+'px';row.style.setProperty('--columns',Math.max(most,240)+'px minmax(0,1fr)')}\n",
    " g.split=make('input',big);g.split.type='range';g.split.max=1000;g.split.value=500;g.split.setAttribute('aria-label','divider between the two pictures');\n",
    " g.split.addEventListener('input',later);var pick=make('div',one);pick.className='pick';\n",
    " ['left','right'].forEach(function(side){var l=make('label',pick,side+' '),e=make('select',l);g[side]=e;\n",
    "  g.sets.forEach(function(v,k){var o=make('option',e,v.name);o.value=k});e.value=side==='left'?Math.min(1,g.sets.length-1):g.sets.length-1;\n",
    "  e.addEventListener('change',later)});if(g.left.value===g.right.value)g.left.value=0;\n",
    " g.badge=make('span',pick);g.badge.className='badge';var strip=make('div',row);strip.className='strip';\n",
    " g.small=g.sets.map(function(v){var f=make('figure',strip),c=make('canvas',f),t=make('figcaption',f);c.width=g.w;c.height=g.h;\n",
    "  c.style.width='100%';make('strong',t,v.name);if(v.note)make('span',t,v.note);return c});\n",
    " g.maps={};g.visible=!window.IntersectionObserver;groups.push(g);\n",
    " if(window.IntersectionObserver)new IntersectionObserver(function(e){g.visible=e[e.length-1].isIntersecting;if(g.visible)later();\n",
    "  else{g.maps={};g.sets.forEach(function(v){d.cache[v.set]=null})}},{rootMargin:'200px'}).observe(s)});\n",
    "var play=document.getElementById('play'),time=document.getElementById('time'),kind=document.querySelectorAll('.pair button');\n",
    "var most=Math.max.apply(null,d.groups.map(function(g){return g.photos.length}).concat(2)),step=0,way=1;\n",
    "function show(){play.textContent=playing?'Pause':'Play';time.value=Math.round(1000*at);later()}\n",
    "play.addEventListener('click',function(){playing=!playing;show()});\n",
    "time.addEventListener('input',function(){playing=false;at=time.value/1000;step=Math.round(at*(most-1));show()});\n",
    "Array.prototype.forEach.call(kind,function(b){b.addEventListener('click',function(){errors=b.dataset.k==='error';\n",
    " Array.prototype.forEach.call(kind,function(o){o.className=o===b?'on':''});document.querySelector('.legend').className='legend'+(errors?' on':'');later()})});\n",
    "function tick(now){if(playing&&now-last>160){last=now;if(step+way<0||step+way>most-1)way=-way;step=Math.max(0,Math.min(most-1,step+way));at=step/(most-1);show()}\n",
    " requestAnimationFrame(tick)}show();requestAnimationFrame(tick)})();",
    NULL};

static void put_colors(gallery* g) {
    gsfix_put(&g->page, "],\"white\":%.3f,\"colors\":[", gsfix_error_white);
    for (int i = 0; i < 256; i++) {
        uint8_t c[3];
        gsfix_map_color(i / 255.0, c);
        gsfix_put(&g->page, "%s%d,%d,%d", i ? "," : "", c[0], c[1], c[2]);
    }
    gsfix_put_raw(&g->page, "],\"groups\":[");
    if (g->list.failed) g->page.html.failed = 1;
    gsf_append_bytes(g->ctx, &g->page.html, g->list.data ? g->list.data + 1 : "", g->list.size ? g->list.size - 1 : 0);
    gsfix_put_raw(&g->page, "]}");
}

static void put_introduction(gallery* g, int shown) {
    const eval_plan* plan = g->plan;
    gsfix_page* p = &g->page;
    gsfix_put_head(p, "gsfixer: gallery of an evaluation");
    gsfix_put_lines(p, gallery_style);
    gsfix_put(p, "<p class=eyebrow>gsfix evaluate</p><h1>Gallery</h1><p class=lede>What each method makes of %s, beside the "
                 "photos, frame by frame. Reconstructions are rendered along the whole capture; below each comparison stands whether "
                 "the frame's photo was trained on or held out.</p><p class=small>Pictures of the first seed and of the start <em>%s</em>; figures are "
                 "means over the held-out photos, or over the frames between the references of a sequence. "
                 "Drag the divider to compare two methods. Tables: tables.md, tables.tex, tables.csv.",
              plan->scene_count == 1 ? "a scene" : "the scenes", plan->inits.items[0]);
    if (shown < plan->scene_count) gsfix_put(p, " %d of %d scenes are shown.", shown, plan->scene_count);
    gsfix_put_raw(p, "</p><noscript><p>The pictures are played by a script, which is switched off here.</p></noscript>\n"
                     "<div class=tool><button id=play>Pause</button><input id=time type=range min=0 max=1000 value=0 "
                     "aria-label=\"position in the sequences\"><div class=pair role=group aria-label=\"what is shown\">"
                     "<button data-k=picture class=on>pictures</button><button data-k=error>error maps</button></div>");
    gsfix_put_legend(p);
    gsfix_put_raw(p, "</div><div id=groups></div>\n<script type=\"application/json\" id=data>{\"sets\":[");
}

// How many scenes fit, and with how many frames.
static int choose_scenes(gallery* g) {
    const eval_plan* plan = g->plan;
    int repairs = 0, sets = 0, shown = plan->scene_count < GALLERY_SCENES ? plan->scene_count : GALLERY_SCENES;
    for (int arm = 0; arm < plan->arm_count; arm++) repairs += plan->arms[arm].restorer != NULL;
    if (plan->tables & EVAL_TABLE_RESTORATION) sets += 2 + repairs;
    if (plan->tables & EVAL_TABLE_RECONSTRUCTION) sets += 1 + plan->view_counts * plan->arm_count;
    if (!sets) sets = 1;
    while (shown > 1 && GALLERY_PICTURES / (shown * sets) < GALLERY_FEWEST) shown--;
    g->frames = GALLERY_PICTURES / (shown * sets);
    if (g->frames > EVAL_PICTURES) g->frames = EVAL_PICTURES;
    if (g->frames < 2) g->frames = 2;
    return shown;
}

gsf_result eval_write_gallery(gsfix_app* app, const eval_plan* plan) {
    gallery g = {app, &app->ctx, plan, {&app->ctx, NULL, {0}}, 0, 0, 0, {0}};
    gsf_result result = GSF_OK;
    const int shown = choose_scenes(&g);
    put_introduction(&g, shown);
    gsf_append_bytes(g.ctx, &g.list, "[", 1); // opened here, so that the first group gets no comma; dropped again when copied
    for (int i = 0; i < shown && result == GSF_OK; i++) {
        const int scene = (int)((int64_t)i * plan->scene_count / shown);
        if (plan->tables & EVAL_TABLE_RESTORATION) result = put_restorations(&g, scene);
        if (result == GSF_OK && plan->tables & EVAL_TABLE_RECONSTRUCTION) result = put_reconstructions(&g, scene);
    }
    put_colors(&g);
    gsfix_put_raw(&g.page, "</script>\n<script>");
    gsfix_put_lines(&g.page, gallery_script);
    gsfix_put_raw(&g.page, "</script></body></html>\n");
    if (result == GSF_OK)
        result = g.page.html.failed ? GSF_ERROR_OUT_OF_MEMORY
                                    : gsf_write_file(g.ctx, gsfix_pathf("%s/gallery.html", app->o.out).s, g.page.html.data,
                                                     g.page.html.size);
    gsf_destroy_buffer(g.ctx, &g.page.html);
    gsf_destroy_buffer(g.ctx, &g.list);
    return result;
}
