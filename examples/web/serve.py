#!/usr/bin/env python3
"""serve.py [FOLDER] [PORT]: serves the page at http://localhost:8000, isolated from other origins so that it may use threads."""
import http.server, sys

class Handler(http.server.SimpleHTTPRequestHandler):
    def end_headers(self):
        self.send_header("Cross-Origin-Opener-Policy", "same-origin")
        self.send_header("Cross-Origin-Embedder-Policy", "require-corp")
        super().end_headers()
    def __init__(self, *args):
        super().__init__(*args, directory=sys.argv[1] if len(sys.argv) > 1 else "build/page")

http.server.ThreadingHTTPServer(("localhost", int(sys.argv[2]) if len(sys.argv) > 2 else 8000), Handler).serve_forever()
