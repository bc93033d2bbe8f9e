#!/usr/bin/env python3
"""The byte-level tokenizer beside transformers' GPT2Tokenizer on seeded random texts: ids and decoded texts must be equal.

    pip install transformers==4.51.3 regex tokenizers        # compare_tokenizers.sh does both
    python3 tests/compare_bpe.py build/tests/test_nn_caption [--folder GOLDEN/encoders/blip2] [--count 10000] [--seed 1]

Runs on the folder's vocabulary and on a larger one that is trained here on this repository's sources. Exit code 0: all
equal.
"""
import argparse, json, os, random, struct, subprocess, sys, tempfile

HERE = os.path.dirname(os.path.abspath(__file__))


def train(folder, size):
    """A tokenizer of `size` tokens from the repository's text and random words of many scripts."""
    from tokenizers import ByteLevelBPETokenizer
    rng = random.Random(7)
    corpus = os.path.join(folder, "corpus.txt")
    with open(corpus, "w", encoding="utf-8") as out:
        for root, _, names in os.walk(os.path.dirname(HERE)):
            for name in sorted(names):
                if name.endswith((".h", ".c", ".md", ".py")) and "/build" not in root:
                    with open(os.path.join(root, name), encoding="utf-8", errors="replace") as source:
                        out.write(source.read())
        for low, high in ((0xc0, 0x24f), (0x391, 0x3c9), (0x410, 0x44f), (0x5d0, 0x5ea), (0x905, 0x939),
                          (0x3041, 0x3096), (0x4e00, 0x4fff), (0x1f600, 0x1f64f)):
            words = ["".join(chr(rng.randint(low, high)) for _ in range(rng.randint(1, 6))) for _ in range(60)]
            out.write("\n" + " ".join(rng.choice(words) for _ in range(4000)))
    trained = ByteLevelBPETokenizer()
    trained.train([corpus], vocab_size=size, min_frequency=2, special_tokens=["<s>", "<pad>", "</s>", "<unk>"],
                  show_progress=False)
    trained.save_model(folder)
    os.remove(corpus)
    count = len(json.load(open(os.path.join(folder, "vocab.json"), encoding="utf-8")))
    names = {"bos_token": "</s>", "eos_token": "</s>", "unk_token": "<unk>", "pad_token": "<pad>"}
    with open(os.path.join(folder, "tokenizer_config.json"), "w") as out:
        json.dump({"tokenizer_class": "GPT2Tokenizer", "add_bos_token": True, "clean_up_tokenization_spaces": True}, out)
    with open(os.path.join(folder, "special_tokens_map.json"), "w") as out: # the older layout: no added_tokens_decoder
        strips = {"content": "<image>", "lstrip": True, "rstrip": True, "single_word": False, "normalized": False}
        json.dump(dict(names, additional_special_tokens=[strips]), out)
    with open(os.path.join(folder, "added_tokens.json"), "w") as out:
        json.dump({"<image>": count, "plain added": count + 1}, out)


def random_texts(count, seed):
    rng = random.Random(seed)
    words = ["a", "photo", "of", "the", "don't", "we've", "I'll", "they're", "it's", "'s", "''d", "3dgs", "2024", "x'T",
             "<image>", "</s>", "<pad>", "<pa", "plain added", "<|endoftext|>", "naïve", "日本語", "ß", "Ǆ", "१२३", "½"]
    spaces = [" ", "  ", "   ", "\t", "\n", "\r\n", "\u00a0", "\u2003", "\u3000", "\x1c", "\x85", "", " \n ", "\u200b"]
    ranges = [(0, 0x7f), (0, 0x1f), (0x20, 0x2fff), (0, 0xd7ff), (0xe000, 0xffff), (0x10000, 0x10ffff), (0x1f300, 0x1faff),
              (0x300, 0x36f), (0x4e00, 0x9fff), (0x80, 0x17f)]
    texts = ["", " ", "  ", "\n", "a" * 100000, " " * 100000, "ab" * 50000, "é" * 30000, "👩‍👩‍👧‍👦" * 2000, "'s" * 20000,
             "\0" * 1000]
    while len(texts) < count:
        text = ""
        for _ in range(rng.randint(0, 12)):
            kind = rng.random()
            if kind < 0.45:
                text += rng.choice(words)
            elif kind < 0.7:
                text += rng.choice(spaces) * rng.choice((1, 1, 1, 2, 5))
            else:
                low, high = rng.choice(ranges)
                text += "".join(chr(rng.randint(low, high)) for _ in range(rng.randint(1, 8)))
        texts.append("".join(c for c in text if not 0xd800 <= ord(c) <= 0xdfff))
    return texts


def compare(program, folder, texts):
    from transformers import GPT2Tokenizer
    official = GPT2Tokenizer.from_pretrained(folder)
    known = set(official.decoder) | set(official.added_tokens_decoder)
    with tempfile.NamedTemporaryFile(suffix=".bin") as file:
        for text in texts:
            data = text.encode("utf-8")
            file.write(struct.pack("<I", len(data)) + data)
        file.flush()
        run = subprocess.run([program, "encode", folder, file.name], check=True, stdout=subprocess.PIPE)
    lines = run.stdout.split(b"\n")
    wrong = 0
    for text, line in zip(texts, lines):
        ids, whole, plain = line.split(b"|")
        ids = [int(i) for i in ids.split()]
        expected = official(text).input_ids
        same = ids == expected and all(i in known for i in ids)
        if same:
            same = bytes.fromhex(whole.decode()).decode("utf-8") == official.decode(ids) and \
                bytes.fromhex(plain.decode()).decode("utf-8") == official.decode(ids, skip_special_tokens=True)
        if not same:
            wrong += 1
            if wrong <= 5:
                print("differs: %r\n    ours     %s\n    official %s" % (text[:80], ids[:40], expected[:40]))
    print("%s: %d tokens, %d texts, %d differ" % (folder, len(official), len(texts), wrong))
    return wrong or len(lines) != len(texts) + 1


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("program")
    parser.add_argument("--folder", default=os.path.join(HERE, "golden", "encoders", "blip2"))
    parser.add_argument("--count", type=int, default=10000)
    parser.add_argument("--size", type=int, default=12000, help="tokens of the vocabulary that is trained")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    texts = random_texts(options.count, options.seed)
    wrong = compare(options.program, options.folder, texts)
    with tempfile.TemporaryDirectory() as folder:
        train(folder, options.size)
        wrong |= compare(options.program, folder, texts)
    sys.exit(1 if wrong else 0)


main()
