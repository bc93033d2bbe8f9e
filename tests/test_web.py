#!/usr/bin/env python3
"""test_web.py PAGE SCRATCH [GSFIX SCENE]: uses the page of examples/web in headless Chromium, as a visitor would: makes a scene,
trains on three photos of it, orbits it with the mouse, drops the splats that it saved, and a file that is none; with GSFIX,
the same splats in the other formats; and SCENE, made by make_scene, as a folder and as files. PSNR rises, the pictures
change, the console has no errors; with threads, where the page is isolated, and without, to the same PSNR. Pictures of
the page are left in SCRATCH. Exits with 77 without Chromium. The page is driven through Chromium's DevTools protocol over
pipes."""
import base64
import functools
import gzip
import http.server
import json
import os
import shutil
import subprocess
import sys
import threading
import time

LIMIT = 300  # seconds for any one thing to happen
STEPS = 100


class Page:
    """A tab of headless Chromium."""

    def __init__(self, profile):
        out, chromium_in = os.pipe()  # Chromium reads its file 3 and writes its file 4
        chromium_out, into = os.pipe()
        program = next(p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p)
        command = [program, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
                   "--disable-extensions", "--remote-debugging-pipe", "--user-data-dir=" + profile,
                   "--window-size=1180,760", "about:blank"]
        # The shell gives Chromium the numbers that it expects.
        self.process = subprocess.Popen(["bash", "-c", 'exec "$@" 3<&%d 4>&%d' % (out, into), "bash"] + command,
                                        pass_fds=(out, into), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        os.close(out)
        os.close(into)
        self.to = os.fdopen(chromium_in, "wb")
        self.answers = os.fdopen(chromium_out, "rb")
        self.left = b""
        self.number = 0
        self.session = None
        self.problems = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "DOM"):
            self.call(domain + ".enable")
        self.call("Emulation.setDeviceMetricsOverride", width=1180, height=760, deviceScaleFactor=1, mobile=False)

    def call(self, method, **parameters):
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        self.to.write(json.dumps(message).encode() + b"\0")
        self.to.flush()
        while True:
            answer = self.read()
            if answer.get("id") == self.number:
                if "error" in answer:
                    raise RuntimeError("%s: %s" % (method, answer["error"]["message"]))
                return answer["result"]

    def read(self):
        while b"\0" not in self.left:
            more = os.read(self.answers.fileno(), 1 << 20)
            if not more:
                raise RuntimeError("Chromium has ended")
            self.left += more
        text, self.left = self.left.split(b"\0", 1)
        message = json.loads(text)
        what, about = message.get("method"), message.get("params", {})
        if what == "Runtime.consoleAPICalled" and about["type"] in ("error", "assert"):
            self.problems.append(" ".join(str(a.get("value", a.get("description"))) for a in about["args"]))
        if what == "Runtime.exceptionThrown":
            self.problems.append(str(about["exceptionDetails"].get("exception", about["exceptionDetails"]).get("description")))
        if what == "Log.entryAdded" and about["entry"]["level"] == "error":
            self.problems.append(about["entry"]["text"])
        return message

    def ask(self, expression):
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in result:
            raise RuntimeError("%s: %s" % (expression, result["exceptionDetails"].get("exception", {}).get("description")))
        return result["result"].get("value")

    def wait(self, expression, what):
        end = time.monotonic() + LIMIT
        while not self.ask(expression):
            error = self.ask("window.gsfixer && gsfixer.error")
            if error or time.monotonic() > end:
                raise RuntimeError("%s: %s" % (what, error or "does not happen"))
            time.sleep(0.1)

    def click(self, name):
        x, y = self.ask("(b => [b.x + b.width / 2, b.y + b.height / 2])(document.getElementById('%s').getBoundingClientRect())"
                        % name)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def drag(self, x, y):
        at = self.ask("(b => [b.x + b.width / 2, b.y + b.height / 2])(document.getElementById('view').getBoundingClientRect())")
        self.call("Input.dispatchMouseEvent", type="mousePressed", x=at[0], y=at[1], button="left", buttons=1, clickCount=1)
        for part in (0.25, 0.5, 0.75, 1.0):
            self.call("Input.dispatchMouseEvent", type="mouseMoved", x=at[0] + x * part, y=at[1] + y * part, button="left",
                      buttons=1)
        self.call("Input.dispatchMouseEvent", type="mouseReleased", x=at[0] + x, y=at[1] + y, button="left", clickCount=1)

    def drop(self, files):
        data = {"items": [], "files": [os.path.abspath(f) for f in files], "dragOperationsMask": 1}
        for kind in ("dragEnter", "dragOver", "drop"):
            self.call("Input.dispatchDragEvent", type=kind, x=300, y=300, data=data)

    def refused(self):  # what the page says about the files dropped last
        end = time.monotonic() + LIMIT
        while not self.ask("gsfixer.error") and time.monotonic() < end:
            time.sleep(0.1)
        said = self.ask("gsfixer.error")
        check(said and self.ask("document.getElementById('message').textContent") == said, "bad files are not refused")
        self.ask("gsfixer.error = ''")
        return said

    def picture(self, path):
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        with open(path, "wb") as file:
            file.write(data)

    def pixels(self):  # of the view: how many colours, and a sum that tells pictures apart
        return self.ask("""(() => { const c = document.getElementById("view"), seen = new Set(), d = c.getContext("2d")
            .getImageData(0, 0, c.width, c.height).data; let sum = 0;
            for (let i = 0; i < d.length; i += 4) { const v = d[i] << 16 | d[i + 1] << 8 | d[i + 2]; seen.add(v);
            sum = (Math.imul(sum, 31) + v) | 0; } return {colours: seen.size, sum, width: c.width, height: c.height}; })()""")

    def settled(self, before):  # the picture after a change
        end = time.monotonic() + LIMIT
        while True:
            now = self.pixels()
            time.sleep(0.3)
            if now["sum"] != before["sum"] and now == self.pixels():
                return now
            if time.monotonic() > end:
                raise RuntimeError("the picture stays the same")

    def close(self):
        try:
            self.session = None
            self.call("Browser.close")
        except (RuntimeError, OSError):
            pass
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class Plain(http.server.SimpleHTTPRequestHandler):  # as any server, without the headers of serve.py
    def log_message(self, *_):
        pass


class Isolated(Plain):
    def end_headers(self):
        self.send_header("Cross-Origin-Opener-Policy", "same-origin")
        self.send_header("Cross-Origin-Embedder-Policy", "require-corp")
        super().end_headers()


def serve(handler, folder):
    server = http.server.ThreadingHTTPServer(("localhost", 0), functools.partial(handler, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return "http://localhost:%d/" % server.server_port


def check(holds, what):
    if not holds:
        raise RuntimeError(what)


def make_and_train(page, address, scratch, name):
    """From a fresh page to the PSNR after some steps on three photos of a made scene."""
    page.call("Page.navigate", url=address)
    page.wait("window.gsfixer && gsfixer.ready", "the page is not ready")
    page.picture(os.path.join(scratch, name + "_start.png"))
    page.ask("document.getElementById('repair').checked = false; document.getElementById('photos').value = 3;"
             "gsfixer.made = {width: 96, height: 72, views: 9, arc: 70}")
    page.click("make")
    page.wait("gsfixer.opened === 1", "no scene is made")
    page.wait("gsfixer.frames > 0", "no picture is shown")
    page.picture(os.path.join(scratch, name + "_made.png"))
    page.ask("gsfixer.trainUntil(%d)" % STEPS)
    page.wait("gsfixer.state.iteration === %d && !gsfixer.training" % STEPS, "the training does not end")
    curve = page.ask("gsfixer.curve()")
    check(len(curve) >= 3 and curve[-1]["psnr"] > curve[0]["psnr"] + 1.0, "PSNR does not rise: %s" % curve)
    return page.ask("gsfixer.state"), curve


def drop_splats(page, saved, scratch, gsfix):
    """The page's own splats, in all formats that it reads, and in one that it does not."""
    plain = os.path.join(scratch, "plain.ply")  # without the colour behind the splats, which no other format keeps
    with open(saved, "rb") as file, open(plain, "wb") as without:
        head, rest = file.read().split(b"end_header\n", 1)
        without.write(b"".join(l for l in head.splitlines(True) if not l.startswith(b"comment")) + b"end_header\n" + rest)
    files = [saved, plain]
    for name, version in (("splats.spz", 3), ("splats.glb", 3), ("splats.splat", 3), ("version_4.spz", 4)) if gsfix else ():
        files.append(os.path.join(scratch, name))
        made = subprocess.run([gsfix, "convert", saved, "--out", files[-1], "--spz-version", str(version)], capture_output=True,
                              text=True)
        if made.returncode and "zstd" in made.stderr:
            files.pop()  # this gsfix was built without it
        else:
            check(made.returncode == 0, made.stderr)
    opened, first, count = 1, None, page.ask("gsfixer.state.splats")
    for name in files:
        before = page.pixels()
        page.drop([name])
        if "version_4" in name:
            said = page.refused()
            check("SPZ 4 needs" in said and "gsfix convert" in said, "no clear line about SPZ 4: " + said)
            page.picture(os.path.join(scratch, "version_4.png"))
            continue
        opened += 1
        page.wait("gsfixer.opened === %d" % opened, name + " is not opened")
        shown = page.settled(before)
        check(shown["colours"] > 100, name + " shows nothing")
        check(page.ask("gsfixer.state.splats") == count, name + " has another number of splats")
        page.picture(os.path.join(scratch, "dropped_%s.png" % os.path.basename(name)))
        # Beside the PLY: what the formats round, and nothing else.
        now = page.ask("[...document.getElementById('view').getContext('2d').getImageData(0, 0, %d, %d).data]"
                       % (shown["width"], shown["height"]))
        if name == plain:
            first = now
        if not first:
            continue
        off = sum(abs(a - b) for a, b in zip(first, now)) / len(now)
        print("%-14s %.2f of 255 from the PLY" % (os.path.basename(name), off))
        check(len(now) == len(first) and off < 6, name + " looks different")
    return opened


def drop_photos(page, scene, scratch, opened):
    """Photos with their COLMAP model: as one folder, then file by file."""
    files = [os.path.join(f, n) for f, _, names in os.walk(scene) for n in sorted(names)]
    files = [f for f in files if os.path.dirname(os.path.relpath(f, scene)) in ("images", os.path.join("sparse", "0"))]
    psnr = []
    for name, dropped in (("folder", [scene]), ("files", files)):
        page.drop(dropped)
        opened += 1
        page.wait("gsfixer.opened === %d" % opened, "photos are not opened as " + name)
        photos = sum(f.endswith(".png") for f in files)
        state = page.ask("gsfixer.state")
        check(state["photos"] == 3 and state["heldOut"] == (photos + 7) // 8, "other photos: %s" % state)
        page.ask("gsfixer.trainUntil(%d)" % STEPS)
        page.wait("gsfixer.state.iteration === %d && !gsfixer.training" % STEPS, "the training does not end")
        curve = page.ask("gsfixer.curve()")
        check(curve[-1]["psnr"] > curve[0]["psnr"] + 0.5, "PSNR does not rise: %s" % curve)
        psnr.append(curve[-1]["psnr"])
        page.picture(os.path.join(scratch, "photos_as_%s.png" % name))
    check(psnr[0] == psnr[1], "another PSNR from files: %s" % psnr)
    print("%d photos dropped: %.2f dB after %d steps" % (photos, psnr[0], STEPS))


def main():
    folder, scratch = sys.argv[1:3]
    if not any(map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))):
        print("SKIPPED: no Chromium")
        return 77
    shutil.rmtree(scratch, ignore_errors=True)
    os.makedirs(scratch)
    for name in ("gsfixer", "gsfixer_threads"):
        size = 0
        for part in (name + ".wasm", name + ".js", name + ".worker.js", "page.js", "index.html"):
            if os.path.exists(os.path.join(folder, part)):
                with open(os.path.join(folder, part), "rb") as file:
                    size += len(gzip.compress(file.read(), 9))
        print("%s: %d bytes, gzipped" % (name, size))
        check(size < 300000, "the page has more than 300 kB")
    page = Page(os.path.join(scratch, "profile"))
    try:
        plain, _ = make_and_train(page, serve(Plain, folder), scratch, "plain")
        isolated = serve(Isolated, folder)
        state, curve = make_and_train(page, isolated, scratch, "isolated")
        check(plain["threads"] == 1, "threads without shared memory")
        check(state["threads"] == min(os.cpu_count(), 8), "%d threads" % state["threads"])
        check(state["kernels"] == "simd128", "kernels are " + state["kernels"])
        check(state["psnr"] == plain["psnr"], "another PSNR with threads")
        print("%s: %.2f dB before, %.2f dB after %d steps" % (state["kernels"], curve[0]["psnr"], state["psnr"], STEPS))
        before = page.pixels()
        check(before["colours"] > 500, "the picture is empty: %s" % before)
        page.drag(180, 40)
        around = page.settled(before)
        page.picture(os.path.join(scratch, "orbited.png"))
        page.call("Input.dispatchMouseEvent", type="mouseWheel", x=400, y=400, deltaX=0, deltaY=-100)
        page.settled(around)

        # The splats of the page itself, in two formats that it reads; and files that are none.
        tests = os.path.dirname(os.path.abspath(__file__))
        page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=os.path.abspath(scratch))
        page.click("save")
        saved = os.path.join(scratch, "splats.ply")
        end = time.monotonic() + LIMIT
        while not os.path.exists(saved) and time.monotonic() < end:
            page.ask("0")
            time.sleep(0.1)
        check(os.path.exists(saved), "nothing is saved")
        opened = drop_splats(page, saved, scratch, sys.argv[3] if sys.argv[3:] else None)
        if sys.argv[4:]:
            drop_photos(page, sys.argv[4], scratch, opened)
        page.drop([os.path.join(tests, "golden/splat/bad/ply/07_bad_magic.ply")])
        said = page.refused()
        check("magic" in said or "ply" in said, "a bad file is not refused: " + said)
        check(not page.problems, "the console says: %s" % "; ".join(page.problems))
    finally:
        page.close()
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (RuntimeError, StopIteration) as error:
        print("FAILED: %s" % error)
        sys.exit(1)
