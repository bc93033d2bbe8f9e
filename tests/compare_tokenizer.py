#!/usr/bin/env python3
"""Compares the tokenizer's ids with those of the sentencepiece and transformers packages, on random strings.

    tests/compare_tokenizer.py TEST_NN_TEXT [--model FOLDER ...] [--train] [--count N] [--seed S]

TEST_NN_TEXT is the built test program, which is run with --tokenize. FOLDER (default: the golden one) holds spiece.model
and what else the tokenizer has. --train makes more models with sentencepiece, of other normalisers, flags and kinds of
piece, from the texts of this checkout, and compares on those, too. Needs pip install sentencepiece==0.2.3
transformers==4.51.3; without them the exit code is 77. Exits 1 where any id differs.
"""
import argparse
import pathlib
import random
import struct
import subprocess
import sys
import tempfile
import warnings

try:
    import sentencepiece
    from transformers import T5Tokenizer
    from transformers.utils import logging
except ImportError:
    print("compare_tokenizer.py: sentencepiece or transformers is not installed", file=sys.stderr)
    sys.exit(77)

ROOT = pathlib.Path(__file__).resolve().parent.parent
SPECIAL = ["</s>", "<pad>", "<unk>", "<extra_id_0>", "<extra_id_7>", "<extra_id_99>", "<extra_id_", "<s>"]
RANGES = [(0x20, 0x7e), (0, 0x1f), (0x7f, 0xff), (0x100, 0x24f), (0x300, 0x36f), (0x370, 0x5ff), (0x900, 0xdff),
          (0x1100, 0x11ff), (0x1680, 0x169f), (0x2000, 0x206f), (0x2070, 0x21ff), (0x2460, 0x27bf), (0x2581, 0x2581),
          (0x3000, 0x30ff), (0x3300, 0x33ff), (0x4e00, 0x9fff), (0xac00, 0xd7a3), (0xe000, 0xe0ff), (0xf900, 0xfdff),
          (0xfe00, 0xffff), (0x1d400, 0x1d7ff), (0x1f300, 0x1faff), (0x20000, 0x2a6df), (0xe0100, 0xe01ef),
          (0x10ff00, 0x10ffff)]


def character(rng, ranges):
    while True:
        c = rng.randint(*rng.choice(ranges))
        if not 0xd800 <= c < 0xe000:
            return chr(c)


def text(rng, pieces, longest):
    """One random string; pieces of the model's own vocabulary make spellings of equal and nearly equal score."""
    kind = rng.randrange(12)
    size = int(rng.expovariate(1 / 30)) if rng.random() < 0.97 else int(rng.expovariate(1 / 500))
    if kind == 0:
        return ""
    if kind == 1 and rng.random() < 0.1:
        size = rng.randint(5000, longest)
    if kind <= 2:
        return "".join(character(rng, RANGES[:1]) for _ in range(size))
    if kind <= 4:
        return "".join(character(rng, RANGES) for _ in range(size))
    if kind == 5:
        part = [rng.choice(RANGES)]
        return "".join(character(rng, part) for _ in range(size))
    if kind <= 8:
        return "".join(rng.choice(pieces).replace("\u2581", rng.choice(["\u2581", " ", ""])) for _ in range(size // 3))
    if kind == 9:
        return rng.choice(pieces)[:3] * size
    if kind == 10:
        few = [" ", "  ", "\t", "\n", "\u3000", "\u200b", "a", "b", ".", "\u2581"]
        return "".join(rng.choice(few) for _ in range(size))
    return "".join(rng.choice(SPECIAL + [" ", "\u00a0", "\x1c", "a b", " x"]) for _ in range(size // 5))


def ours(program, folder, texts):
    data = b"".join(struct.pack("<I", len(t)) + t for t in (s.encode() for s in texts))
    lines = subprocess.run([program, "--tokenize", folder], input=data, stdout=subprocess.PIPE, check=True).stdout
    return [[int(i) for i in line.split()] for line in lines.decode().splitlines()]


def compare(program, folder, options):
    model = pathlib.Path(folder) / "spiece.model"
    raw = sentencepiece.SentencePieceProcessor(model_file=str(model))
    whole = (pathlib.Path(folder) / "tokenizer_config.json").exists()
    official = T5Tokenizer.from_pretrained(folder) if whole else T5Tokenizer(str(model), legacy=True)
    rng = random.Random(options.seed)
    pieces = [raw.id_to_piece(i) for i in range(raw.get_piece_size())]
    texts = [text(rng, pieces, 100000) for _ in range(options.count)]
    differ, alone = 0, 0
    for t, ids in zip(texts, ours(program, folder, texts), strict=True):
        expected = official(t).input_ids
        same = ids == expected
        if not any(s in t for s in official.all_special_tokens):  # sentencepiece knows nothing of added tokens
            alone += 1
            same &= ids == raw.encode(t) + [raw.eos_id()]
        if not same:
            differ += 1
            if differ <= 3:
                print(f"  {t[:80]!r} ({len(t)})\n    ours     {ids[:40]}\n    official {expected[:40]}\n"
                      f"    alone    {raw.encode(t)[:40]}")
    characters = sum(map(len, texts))
    print(f"{folder}: {raw.get_piece_size()} pieces, {len(texts)} texts of {characters} characters: {differ} differ from "
          f"transformers, or, of {alone}, from sentencepiece", flush=True)
    return differ


def train(where):
    """Folders of models; each leaves another way through the code."""
    lines = [line for path in sorted(ROOT.glob("*.h")) + sorted(ROOT.glob("*/*.[ch]")) + sorted(ROOT.glob("*/*.md"))
             for line in path.read_text(errors="replace").splitlines() if 8 < len(line) < 400]
    rng = random.Random(1)
    lines += ["".join(character(rng, RANGES) for _ in range(40)) for _ in range(500)]
    lines = rng.sample(lines, min(20000, len(lines)))
    kinds = {
        "large": {"vocab_size": 16000},
        "user": {"vocab_size": 2000, "user_defined_symbols": ["<sep>", "ab", "th", "  ", "\u4e2d\u6587", "then"]},
        "bytes": {"vocab_size": 2000, "byte_fallback": True},
        "spaces": {"vocab_size": 2000, "remove_extra_whitespaces": False, "add_dummy_prefix": False,
                   "allow_whitespace_only_pieces": True, "normalization_rule_name": "identity"},
        "suffix": {"vocab_size": 2000, "treat_whitespace_as_suffix": True, "normalization_rule_name": "nfkc_cf"},
    }
    for name, options in kinds.items():
        folder = pathlib.Path(where) / name
        folder.mkdir()
        sentencepiece.SentencePieceTrainer.train(
            sentence_iterator=iter(lines), model_prefix=str(folder / "spiece"), model_type="unigram", pad_id=0, eos_id=1,
            unk_id=2, bos_id=-1, hard_vocab_limit=False, character_coverage=0.99, minloglevel=2, num_threads=2, **options)
        yield str(folder)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program")
    parser.add_argument("--model", action="append")
    parser.add_argument("--train", action="store_true")
    parser.add_argument("--count", type=int, default=10000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    logging.set_verbosity_error()
    warnings.simplefilter("ignore")
    models = options.model or [str(ROOT / "tests/golden/restorer/model/tokenizer")]
    differ = sum(compare(options.program, m, options) for m in models)
    if options.train:
        with tempfile.TemporaryDirectory() as where:
            differ += sum(compare(options.program, m, options) for m in train(where))
    return 1 if differ else 0


if __name__ == "__main__":
    sys.exit(main())
