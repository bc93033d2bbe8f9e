#!/usr/bin/env python3
"""Holds the public functions and types of the headers to the naming table in the documentation of gsfixer.h.

Checked: every public function is gsf_VERB... (in a module gsf_traj_VERB..., gsf_splat_VERB..., gsf_nn_VERB...) with a verb of the
table, has a comment, is defined, and is called by the library, a program, an example or README's sample: what only tests and
benches call is internal. There are at most 160. Types and enumerators are named as the table says, flags and counts have a fixed
size. Compiled with $CC (default cc), an implementation exports exactly these functions.

    api.py          checks; exits with 1 where something is wrong
    api.py --list   prints each function with the places that call it"""
import collections
import os
import re
import subprocess
import sys
import tempfile

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
HEADERS = ["gsfixer.h", "gsfixer_traj.h", "gsfixer_splat.h", "gsfixer_nn.h"]
PREFIXES = {"gsfixer.h": "gsf_", "gsfixer_traj.h": "gsf_traj_", "gsfixer_splat.h": "gsf_splat_", "gsfixer_nn.h": "gsf_nn_"}
MOST = 160

wrong = []


def fail(text):
    wrong.append(text)


def read(path):
    with open(os.path.join(ROOT, path), encoding="utf-8") as file:
        return file.read()


def without_comments(text):
    return re.sub(r"/\*.*?\*/", "", re.sub(r"//[^\n]*", "", text), flags=re.S)


def api_end(text):
    return re.search(r"(?m)^#endif // GSF_\w+_INCLUDED", text).start()


def table():
    """Verbs of the chapter NAMES: the words in front of two spaces."""
    chapter = re.search(r"(?ms)^   NAMES .*?^   [A-Z]+ ", read("gsfixer.h"))
    if not chapter:
        sys.exit("gsfixer.h: its documentation has no chapter NAMES")
    verbs = []
    for line in re.findall(r"(?m)^       ([a-z ]+?)  +\S", chapter.group(0)):
        verbs += line.split()
    twice = [verb for verb, count in collections.Counter(verbs).items() if count > 1]
    if twice:
        fail("gsfixer.h: NAMES has %s twice" % ", ".join(twice))
    return set(verbs)


def declarations(header):
    """Names of the public functions, with the comment above the declaration or above the group that it stands in."""
    text = read(header)
    api = text[:api_end(text)]
    found = {}
    for match in re.finditer(r"(?m)^GSF_API ([^;{}]*?)\b(gsf_\w+)\(([^;{}]*?)\)[^;{}()]*(?:GSF_PRINTF\([^)]*\))?;([^\n]*)", api):
        group = api[:match.start()].rstrip("\n").split("\n\n")[-1] # up to the last empty line
        documented = bool(re.search(r"(?m)^(//|.*\*/$)|; //", group)) or "//" in match.group(4)
        found[match.group(2)] = (documented, match.group(1) + " " + match.group(3))
    for match in re.finditer(r"(?m)^GSF_API [^(;]*?(gsf_\w+)\(", api):
        if match.group(1) not in found:
            fail("%s: the declaration of %s cannot be read" % (header, match.group(1)))
    return found


def words(text):
    return collections.Counter(re.findall(r"\bgsf_\w+(?=\s*\()", text))


def callers(functions):
    """Where each function is called: the headers' implementations (less the definition), programs, README."""
    places = collections.defaultdict(list)

    def note(place, counts, own=()):
        for name in functions:
            if counts[name] > (name in own):
                places[name].append(place)

    for header in HEADERS:
        text = read(header)
        code = without_comments(text[api_end(text):])
        for name in declarations(header):
            if not re.search(r"(?m)^GSF_API [^;{}]*?\b%s\([^;{}]*\)\s*\{" % name, code):
                fail("%s: %s is not defined" % (header, name))
        note(header, words(code), declarations(header))
    for name in sorted(os.listdir(os.path.join(ROOT, "examples"))):
        if name.endswith((".c", ".h")):
            note("examples/" + name, words(without_comments(read("examples/" + name))))
    note("README.md", words(without_comments("".join(re.findall(r"(?s)```c\n(.*?)```", read("README.md"))))))
    return places


def check_types(header):
    text = read(header)
    api = without_comments(text[:api_end(text)])
    prefix = {"gsfixer_traj.h": "gsf_traj_", "gsfixer_nn.h": "gsf_nn_"}.get(header, "gsf_")
    for name in re.findall(r"\btypedef (?:struct|enum) (\w+)", api):
        if not name.startswith(prefix) and not name.startswith("gsf__"):
            fail("%s: type %s is not called %s..." % (header, name, prefix))
    for name, body in re.findall(r"(?s)\btypedef enum (\w+) \{(.*?)\}", api):
        stem = "GSF_" + name[len("gsf_"):].upper()
        module = re.match(r"GSF_NN_", stem)
        first = "_".join(stem.split("_")[:3 if module else 2]) + "_" # the type's name without what follows its first word
        if name in ("gsf_result", "gsf_dtype", "gsf_nn_dtype"):
            first = "GSF_"
        for value in re.findall(r"\b(GSF_\w+)\b", re.sub(r"=[^,}]*|#.*|GSF_RESULTS\(\w+\)", "", body)):
            if not value.startswith(first):
                fail("%s: %s of %s does not begin with %s" % (header, value, name, first))
    for line in re.findall(r"(?m)^    (?:unsigned |const )?int [^;(]*;", api):
        fail("%s: a member has no size of its own: %s" % (header, line.strip()))


def exported():
    """Names that an implementation of all headers exports."""
    with tempfile.TemporaryDirectory() as folder:
        source, unit = os.path.join(folder, "unit.c"), os.path.join(folder, "unit.o")
        with open(source, "w", encoding="utf-8") as file:
            file.write("#define GSFIXER_IMPLEMENTATION\n" + "".join('#include "%s"\n' % header for header in HEADERS))
        subprocess.run([os.environ.get("CC", "cc"), "-std=c11", "-O0", "-w", "-I", ROOT, "-c", source, "-o", unit], check=True)
        listing = subprocess.run(["nm", "-g", "--defined-only", unit], check=True, capture_output=True, text=True).stdout
    return set(line.split()[-1] for line in listing.splitlines() if line.strip())


def main():
    verbs = table()
    functions, used = {}, set()
    for header in HEADERS:
        for name, (documented, signature) in declarations(header).items():
            functions[name] = header
            rest = name[len(PREFIXES[header]):] if name.startswith(PREFIXES[header]) else ""
            if rest.split("_")[0] not in verbs:
                fail("%s: %s begins with no verb of the table" % (header, name))
            if not documented:
                fail("%s: %s has no comment" % (header, name))
            if re.search(r"\bint [a-z]", signature) or re.match(r"(GSF_NODISCARD )?int ", signature):
                fail("%s: %s takes or returns an int without a size of its own" % (header, name))
            for kind, parameter in re.findall(r"\b(gsf_\w+)\*+ (desc|stats)\b", signature):
                if not kind.endswith("_" + parameter):
                    fail("%s: %s of %s is a %s" % (header, parameter, name, kind))
            if rest.startswith("query_"):
                for kind in re.findall(r"(?<!const )\b(gsf_(?!context)\w+)\*+ \w+", signature):
                    if not kind.endswith("_info"):
                        fail("%s: %s answers with a %s" % (header, name, kind))
            used.add(rest.split("_")[0])
        check_types(header)
    for verb in sorted(verbs - used):
        fail("gsfixer.h: no function begins with %s of the chapter NAMES" % verb)
    places = callers(functions)
    for name, header in functions.items():
        if "--list" in sys.argv:
            print("%-36s %s" % (name, " ".join(places[name]) or "-"))
        if not places[name]:
            fail("%s: only tests and benches call %s" % (header, name))
    if len(functions) > MOST:
        fail("%d public functions, more than %d" % (len(functions), MOST))
    if sys.platform.startswith("linux"):
        names = exported()
        for name in sorted(names - set(functions)):
            fail("an implementation exports %s" % name)
        for name in sorted(set(functions) - names):
            fail("an implementation does not export %s" % name)
    for text in wrong:
        print(text, file=sys.stderr)
    print("%d public functions, %d verbs, %d wrong" % (len(functions), len(verbs), len(wrong)))
    return 1 if wrong else 0


sys.exit(main())
