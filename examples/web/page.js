// page.js - the page of examples/web, and the worker that runs the library for it, so that the page always answers the mouse.
// SPDX-License-Identifier: MIT
"use strict";
const inWorker = typeof document === "undefined";
// Photos of a made scene, around an arc of so many degrees; milliseconds of training between two looks at the mouse.
const MADE = {width: 192, height: 144, views: 14, arc: 70}, BUDGET = 30;

// ---- worker ----------------------------------------------------------------------------

function startWorker() {
    let gs, size = {width: 640, height: 480}, training = false, until = 0, stale = false, moving = false, drawn = 0, time = 0;
    const waiting = new MessageChannel(); // to come back after the messages of the page
    waiting.port1.onmessage = tick;
    let scheduled = false;
    const schedule = () => { if (!scheduled) { scheduled = true; waiting.port2.postMessage(0); } };

    const check = (code) => { if (code) throw new Error(gs.UTF8ToString(gs._web_error()) || "out of memory"); };
    const withText = (text, call) => {
        const size = gs.lengthBytesUTF8(text) + 1, at = gs._malloc(size);
        gs.stringToUTF8(text, at, size);
        try { return call(at); } finally { gs._free(at); }
    };
    const memory = () => (gs.wasmMemory || gs.HEAPU8).buffer; // anew each time, as it grows; the former in the module with threads
    const bytes = () => new Uint8Array(memory());
    const number = (at) => new DataView(memory()).getInt32(at, true);
    const state = () => JSON.parse(gs.UTF8ToString(gs._web_state()));
    // A copy of the library's pixels, as RGBA.
    const pixels = (at, width, height, channels) => {
        if (!at) throw new Error(gs.UTF8ToString(gs._web_error()) || "out of memory");
        const from = bytes().subarray(at, at + width * height * channels), to = new Uint8ClampedArray(width * height * 4);
        if (channels === 4) to.set(from);
        else for (let i = 0, k = 0; i < to.length; i += 4, k += 3) {
            to[i] = from[k]; to[i + 1] = from[k + 1]; to[i + 2] = from[k + 2]; to[i + 3] = 255;
        }
        return to;
    };
    const show = (type, width, height, data) => postMessage({type, width, height, data, time}, [data.buffer]);

    function draw() {
        const detail = moving && time > 40 ? 2 : 1, begin = performance.now();
        const width = Math.ceil(size.width / detail), height = Math.ceil(size.height / detail);
        const data = pixels(gs._web_render(width, height), width, height, 4);
        if (detail === 1) time = performance.now() - begin;
        show("view", width, height, data);
        drawn = performance.now();
        stale = detail > 1;
    }
    function showHeldOut(render) {
        const at = gs._malloc(8), picture = gs._web_held_out(render, at), width = number(at), height = number(at + 4);
        gs._free(at);
        if (picture) show(render ? "render" : "photo", width, height, pixels(picture, width, height, render ? 4 : 3));
    }
    function tick() {
        scheduled = false;
        try {
            if (training) {
                check(gs._web_train(moving ? 0 : BUDGET, until));
                const s = state();
                if (s.done || (until && s.iteration >= until)) training = false;
                const last = !training;
                if (last || performance.now() - drawn > 200 + 2 * time) {
                    showHeldOut(1);
                    stale = true;
                }
                postMessage({type: "state", state: s, training});
            }
            if (stale && (!training || moving || performance.now() - drawn > 200)) draw();
        } catch (error) {
            training = stale = false;
            postMessage({type: "error", text: error.message});
        }
        if (training || (stale && !moving)) schedule();
    }
    function open(message) {
        training = false;
        check(gs._web_open(size.width, size.height, message.photos, message.repair ? 1 : 0, message.steps || 0));
        const s = state();
        postMessage({type: "opened", state: s});
        showHeldOut(0);
        showHeldOut(1);
        stale = true;
        schedule();
    }
    function make(message) {
        const made = message.made;
        const count = gs._web_make_begin(message.layout, message.seed, made.views, made.arc, made.width, made.height);
        if (!count) throw new Error("out of memory");
        for (let i = 0; i < count; i++) {
            const photo = gs._web_make_photo(i);
            show("photo", made.width, made.height, pixels(photo, made.width, made.height, 3));
            postMessage({type: "progress", text: `Taking photo ${i + 1} of ${count} of a made scene`, part: (i + 1) / count});
        }
        check(gs._web_make_end());
        open(message);
    }
    function openFiles(message) {
        gs._web_forget_files();
        for (const file of message.files) {
            const at = withText(file.path, (path) => gs._web_add_file(path, file.data.byteLength));
            if (!at) throw new Error("too many files, or out of memory");
            bytes().set(new Uint8Array(file.data), at);
        }
        open(message);
    }
    function save(name) {
        const at = gs._malloc(4), data = withText(name, (text) => gs._web_save(text, at)), length = number(at);
        gs._free(at);
        if (!data) check(1);
        const copy = bytes().slice(data, data + length);
        postMessage({type: "saved", name, data: copy}, [copy.buffer]);
    }
    const actions = {
        make, open: openFiles,
        size: (m) => { size = m; },
        train: (m) => { training = m.on; until = m.until || 0; },
        orbit: (m) => gs._web_orbit(m.x, m.y), pan: (m) => gs._web_pan(m.x, m.y), zoom: (m) => gs._web_zoom(m.steps),
        moving: (m) => { moving = m.on; },
        save: (m) => save(m.name),
    };
    onmessage = async (event) => {
        const message = event.data;
        try {
            if (message.type === "start") {
                // Threads need memory that workers share, which a page gets only if it is isolated from other origins.
                const name = message.threads > 1 ? "gsfixer_threads" : "gsfixer";
                importScripts(name + ".js");
                gs = await makeGsfixer({mainScriptUrlOrBlob: name + ".js", locateFile: (path) => path});
                check(gs._web_start(message.threads));
                postMessage({type: "ready", state: state()});
                return;
            }
            actions[message.type](message);
            if (["orbit", "pan", "zoom", "moving"].includes(message.type)) stale = true;
            schedule();
        } catch (error) {
            postMessage({type: "error", text: error.message});
        }
    };
}

// ---- page ------------------------------------------------------------------------------

function startPage() {
    const $ = (id) => document.getElementById(id);
    const layouts = ["courtyard", "still life", "living room", "corridor", "bookshelf", "street", "facade", "garden", "monument",
                     "kitchen", "gallery", "market"];
    const splatFile = /\.(ply|spz|glb|splat)$/i;
    const threads = self.crossOriginIsolated ? Math.min(navigator.hardwareConcurrency || 1, 8) : 1;
    const worker = new Worker("page.js");
    let curve = [], training = false, canTrain = false, busy = true, seed = 1, steps = 0;
    // For programs that drive the page: what it last heard, and training up to a step.
    const app = window.gsfixer = {state: null, training: false, ready: false, opened: 0, error: "", made: {...MADE}, curve: () => curve,
                                  trainUntil: (until) => train(true, until), setSteps: (count) => { steps = count; }};

    const send = (type, more, transfer) => worker.postMessage({type, ...more}, transfer || []);
    const say = (text, isError) => {
        $("message").textContent = text;
        $("message").className = isError ? "error" : "";
    };
    function setBusy(on) {
        busy = on;
        for (const id of ["open", "make"]) $(id).disabled = on;
        $("train").disabled = on || !canTrain;
        $("save").disabled = on || !app.opened;
    }
    function train(on, until) {
        training = app.training = on;
        $("train").textContent = on ? "Pause" : "Train";
        send("train", {on, until});
    }
    function put(id, message) {
        const canvas = $(id);
        if (canvas.width !== message.width || canvas.height !== message.height) {
            canvas.width = message.width;
            canvas.height = message.height;
        }
        canvas.getContext("2d").putImageData(new ImageData(message.data, message.width, message.height), 0, 0);
    }
    function drawCurve(iterations) {
        const canvas = $("curve"), c = canvas.getContext("2d"), left = 56, bottom = canvas.height - 34, top = 14,
              right = canvas.width - 14;
        c.clearRect(0, 0, canvas.width, canvas.height);
        if (!curve.length) return;
        const values = curve.map((p) => p.psnr), low = Math.floor(Math.min(...values)), high = Math.max(low + 2, Math.ceil(Math.max(...values)));
        const x = (step) => left + (right - left) * step / Math.max(iterations, 1), y = (psnr) => bottom - (bottom - top) * (psnr - low) / (high - low);
        c.font = "20px system-ui, sans-serif";
        c.fillStyle = "#98a2b0";
        c.strokeStyle = "#2c333d";
        c.textBaseline = "middle";
        const every = Math.max(1, Math.ceil((high - low) / 5));
        for (let psnr = low; psnr <= high; psnr += every) {
            c.textAlign = "right";
            c.fillText(psnr, left - 10, y(psnr));
            c.beginPath();
            c.moveTo(left, y(psnr));
            c.lineTo(right, y(psnr));
            c.stroke();
        }
        c.textAlign = "left";
        c.fillText("0", left, bottom + 20);
        c.textAlign = "right";
        c.fillText(`${iterations} steps`, right, bottom + 20);
        c.strokeStyle = "#6db3ff";
        c.lineWidth = 3;
        c.beginPath();
        curve.forEach((p, i) => i ? c.lineTo(x(p.step), y(p.psnr)) : c.moveTo(x(p.step), y(p.psnr)));
        c.stroke();
        c.lineWidth = 1;
        c.fillStyle = "#6db3ff";
        const last = curve[curve.length - 1];
        c.beginPath();
        c.arc(x(last.step), y(last.psnr), 5, 0, 7);
        c.fill();
    }
    function showState(s) {
        app.state = s;
        const psnr = s.heldOut && s.psnr !== null ? s.psnr : null;
        if (s.iterations && psnr !== null && (!curve.length || curve[curve.length - 1].step < s.measured)) {
            curve.push({step: s.measured, psnr});
            drawCurve(s.iterations);
        }
        $("step").textContent = s.iterations ? `${s.iteration} of ${s.iterations}` : "–";
        $("psnr").textContent = s.iterations && psnr !== null ? `${psnr.toFixed(2)} dB` : "–";
        $("loss").textContent = s.iteration ? s.loss.toFixed(4) : "–";
        $("splats").textContent = s.splats ? s.splats.toLocaleString("en") : "–";
        $("count").textContent = s.iterations ? s.photos : "–";
        $("held").textContent = s.iterations ? s.heldOut : "–";
        $("threads").textContent = `${s.threads}, ${s.kernels}`;
        $("progress").value = s.iterations ? s.iteration / s.iterations : 0;
        $("stage").textContent = !s.iterations ? "Nothing to train on" : s.done ? "Trained"
            : s.restoring ? `Repairing new views, round ${s.round}` : training ? "Training" : "Ready to train";
    }
    const heard = {
        ready: (m) => {
            app.ready = true;
            showState(m.state);
            setBusy(false);
            say(threads > 1 ? `Ready, with ${m.state.threads} threads.`
                            : "Ready, with one thread: this page may not share memory between threads (see serve.py).");
        },
        progress: (m) => { $("progress").value = m.part; $("stage").textContent = m.text; },
        opened: (m) => {
            app.opened++;
            curve = [];
            drawCurve(0);
            canTrain = m.state.iterations > 0;
            train(false);
            showState(m.state);
            setBusy(false);
            $("hint").style.display = "none";
            document.body.classList.toggle("splats", !canTrain);
            say("Drag to orbit, right-drag to pan, wheel to come closer.");
        },
        view: (m) => { put("view", m); $("time").textContent = `${m.time.toFixed(0)} ms`; app.frames = (app.frames || 0) + 1; },
        photo: (m) => put("photo", m),
        render: (m) => put("render", m),
        state: (m) => {
            if (training && !m.training) train(false);
            showState(m.state);
        },
        saved: (m) => {
            const link = document.createElement("a");
            link.href = URL.createObjectURL(new Blob([m.data]));
            link.download = m.name;
            link.click();
            setTimeout(() => URL.revokeObjectURL(link.href), 10000);
        },
        error: (m) => {
            app.error = m.text;
            train(false);
            setBusy(!app.ready);
            say(m.text, true);
        },
    };
    worker.onmessage = (event) => heard[event.data.type](event.data);
    worker.onerror = (event) => heard.error({text: event.message || "the worker cannot be started"});

    const settings = () => ({photos: Number($("photos").value), repair: $("repair").checked, steps});
    const sendSize = () => { // as the canvas is shown, with at most 640 x 480 pixels
        const box = $("view").getBoundingClientRect(), scale = Math.min(1, Math.sqrt(640 * 480 / Math.max(box.width * box.height, 1)));
        send("size", {width: Math.max(16, Math.round(box.width * scale)), height: Math.max(16, Math.round(box.height * scale))});
    };
    async function openFiles(files) { // [{path, file}]
        files = files.filter((f) => f.file.size > 0);
        if (!files.length || busy) return;
        // Of one splat file among others only scenes have a use, as the points of a transforms.json.
        const splats = files.filter((f) => splatFile.test(f.path)), isScene = files.some((f) => /\.(json|txt|bin)$/i.test(f.path));
        if (splats.length && !isScene) files = splats.slice(0, 1);
        setBusy(true);
        say(`Reading ${files.length === 1 ? files[0].path : files.length + " files"}…`);
        try {
            const read = await Promise.all(files.map(async (f) => ({path: f.path, data: await f.file.arrayBuffer()})));
            sendSize();
            send("open", {files: read, ...settings()}, read.map((f) => f.data));
        } catch (error) {
            heard.error({text: error.message});
        }
    }
    async function walk(entry, into) { // files of a dropped folder
        if (entry.isFile) {
            const file = await new Promise((done, fail) => entry.file(done, fail));
            into.push({path: entry.fullPath.replace(/^\//, ""), file});
            return;
        }
        const reader = entry.createReader();
        for (;;) { // a reader lists 100 at a time
            const some = await new Promise((done, fail) => reader.readEntries(done, fail));
            if (!some.length) return;
            for (const below of some) await walk(below, into);
        }
    }
    addEventListener("dragover", (event) => { event.preventDefault(); document.body.classList.add("over"); });
    addEventListener("dragleave", () => document.body.classList.remove("over"));
    addEventListener("drop", async (event) => {
        event.preventDefault();
        document.body.classList.remove("over");
        const entries = [...event.dataTransfer.items].map((i) => i.webkitGetAsEntry && i.webkitGetAsEntry());
        const files = [...event.dataTransfer.files].map((file) => ({path: file.name, file}));
        if (!entries.some((e) => e && e.isDirectory)) return openFiles(files);
        const found = [];
        try {
            for (const entry of entries) if (entry) await walk(entry, found);
        } catch (error) {
            return heard.error({text: error.message});
        }
        openFiles(found);
    });
    $("open").onclick = () => $("input").click();
    $("input").onchange = () => {
        openFiles([...$("input").files].map((file) => ({path: file.webkitRelativePath || file.name, file})));
        $("input").value = ""; // so that the same files can be chosen again
    };
    $("make").onclick = () => {
        setBusy(true);
        say("Ray-tracing photos of a made scene…");
        sendSize();
        send("make", {layout: Number($("layout").value), seed: seed++, made: app.made, ...settings()});
    };
    $("train").onclick = () => train(!training);
    $("save").onclick = () => send("save", {name: "splats.ply"});

    const view = $("view");
    let button = -1, waiting = null;
    const move = (type, x, y) => { // one message per frame of the display
        if (!waiting) requestAnimationFrame(() => { send(waiting.type, waiting); waiting = null; });
        if (waiting && waiting.type === type) { waiting.x += x; waiting.y += y; } else waiting = {type, x, y};
    };
    view.onpointerdown = (event) => {
        if (!app.opened) return;
        button = event.button;
        view.setPointerCapture(event.pointerId);
        send("moving", {on: true});
    };
    view.onpointermove = (event) => {
        if (button < 0) return;
        const scale = button ? view.width / view.getBoundingClientRect().width : 1; // panning follows the picture's pixels
        move(button ? "pan" : "orbit", event.movementX * scale, event.movementY * scale);
    };
    view.onpointerup = view.onpointercancel = () => {
        if (button < 0) return;
        button = -1;
        send("moving", {on: false});
    };
    view.oncontextmenu = (event) => event.preventDefault();
    view.addEventListener("wheel", (event) => {
        event.preventDefault();
        if (app.opened) send("zoom", {steps: -Math.sign(event.deltaY)});
    }, {passive: false});
    layouts.forEach((name, i) => $("layout").add(new Option(name, i, i === 1, i === 1)));
    send("start", {threads});
}

if (inWorker) startWorker();
else startPage();
