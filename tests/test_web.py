#!/usr/bin/env python3
"""test_web.py PAGE SCRATCH: uses the page of examples/web in headless Chromium, as a visitor would: makes a scene, trains on three
photos of it, orbits it with the mouse, drops the splats that it saved, and a file that is none. PSNR rises, the pictures
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
        opened = 1
        for name in [saved] + [os.path.join(scratch, n) for n in sys.argv[3:]]:
            before = page.pixels()
            page.drop([name])
            opened += 1
            page.wait("gsfixer.opened === %d" % opened, name + " is not opened")
            check(page.settled(before)["colours"] > 100, name + " shows nothing")
        page.picture(os.path.join(scratch, "dropped.png"))
        page.drop([os.path.join(tests, "golden/splat/bad/ply/07_bad_magic.ply")])
        end = time.monotonic() + LIMIT
        while not page.ask("gsfixer.error") and time.monotonic() < end:
            time.sleep(0.1)
        check("magic" in page.ask("gsfixer.error") or "ply" in page.ask("gsfixer.error"), "a bad file is not refused")
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
