"""A decoder of model files in plain Python, written from the docstrings of `p4dgs_ref/codec`, sharing no code with it.

A refusal is ValueError(section or "container", why).  Where a port whose numbers are doubles passes 2^53, it says so.
"""

import json
import struct
import zlib
from bisect import bisect_right
from itertools import accumulate, product
from math import ceil, frexp, isfinite, ldexp, prod
from pathlib import Path

TABLES = json.loads(
    (Path(__file__).resolve().parents[2] / "p4dgs_ref" / "codec" / "tables.json").read_text()
)
SECTIONS = (
    "header positions features scales offset_scales offsets masks hash_grid deformation_mlp anchor_mlps "
    "context_mlps"
).split()
HEADS = {"translation": 3, "scaling": 3, "rotation": 4}


def need(holds, section, why):
    if not holds:
        raise ValueError(section, why)


def clip(value, least, most):
    return max(least, min(value, most))


def halve(y, s):  # y / 2^s, ties up; for s < 0 a port saturates before it shifts
    return y + (1 << s >> 1) >> s if s >= 0 else y << min(-s, 64)


def read_container(data):
    need(
        len(data) >= 18 and data[:9] == b"\x89P4D\r\n\x1a\n\x01",
        "container",
        "size, magic or version",
    )
    start, total, sections = 18 + 9 * data[9], int.from_bytes(data[10:14], "little"), {}
    crc = zlib.crc32(data[: start - 4]).to_bytes(4, "little")
    need(
        start <= total == len(data) and crc == data[start - 4 : start],
        "container",
        "total length or checksum",
    )
    ids, lengths, sums = zip((0, start, 0), *struct.iter_unpack("<BII", data[14 : start - 4]))
    need(
        ids[-1] <= 11 and list(ids) == sorted({*ids}) and sum(lengths) == len(data),
        "container",
        "ids or lengths",
    )
    for number, end, length, crc in list(zip(ids, accumulate(lengths), lengths, sums))[1:]:
        sections[SECTIONS[number - 1]] = data[end - length : end]
        need(zlib.crc32(data[end - length : end]) == crc, SECTIONS[number - 1], "checksum")
    for name in SECTIONS:
        need(name in sections or name == "deformation_mlp", name, "missing")
    return sections


def read_header(body):  # the fields, the entries T of each level, the widths of the four groups
    try:
        h = json.loads(body.decode("ascii"))
        T = [min(R ** len(axes), h["table"][len(axes) == 2]) for axes, R in h["grid"]]
        numbers = h["anchors"] * (9 + h["d"] + 4 * h["k"]) + h["F"] * sum(
            T
        )  # and the weights, see below
        need(
            0 < h["F"] * sum(T) <= 2**24 and 0 < numbers <= 2**25 and len(h["Q_0"]) == 4,
            "header",
            "sizes",
        )
        need(
            {*h["effects"]} <= {*HEADS, "view_color", "view_geometry", "occlusion", "background"},
            "header",
            "effects",
        )
        return h, T, [h["d"], 3, 3, 3 * h["k"]]
    except (LookupError, TypeError, ValueError, RecursionError) as error:
        raise ValueError("header", "a field that is missing, unknown or out of range") from error


def read_networks(
    sections, h, widths
):  # {section: its numbers}; of psi_p and psi_q: (widths, numbers)
    seen, shape = (
        h["d"] + 4 * (effect in h["effects"]) for effect in ("view_color", "view_geometry")
    )
    moved, heads = (
        3 * (1 + 2 * h["L_x"]) + 1 + 2 * h["L_t"],
        sum(HEADS.get(effect, 0) for effect in h["effects"]),
    )
    nets = {
        "anchor_mlps": [
            (I, *h["hidden"], n * h["k"])
            for I, n in ((shape, 1), (seen, 3), (shape, 4), (shape, 3))
        ],
        "deformation_mlp": [(moved, *h["deformation"], heads)]
        * (heads > 0),  # three heads: as many numbers as one
        "context_mlps": [(len(h["grid"]) * h["F"], *h["context"], n) for n in (2 * sum(widths), 4)],
    }
    numbers = {}
    for name, members in nets.items():
        counts, body = (
            [sum((I + 1) * J for I, J in zip(net, net[1:])) for net in members],
            sections.get(name, b""),
        )
        need((name in sections) == bool(members) and len(body) == 2 * sum(counts), name, "length")
        numbers[name] = struct.unpack(f"<{sum(counts)}e", body)
        need(all(map(isfinite, numbers[name])), name, "no number")
    return numbers, list(zip(nets[name], (numbers[name][: counts[0]], numbers[name][counts[0] :])))


def run_network(x, net, numbers):  # the last layer's outputs, their units 2^-a and their bound B
    a, B, X = 15, 0, 2**15
    for i, (I, J) in enumerate(zip(net, net[1:])):
        if i:
            s = max(0, B.bit_length() - 22)
            x, a, X = [max(0, halve(y, s)) for y in x], a - s, halve(B, s)
        W, b, numbers = numbers[: I * J], numbers[I * J : (I + 1) * J], numbers[(I + 1) * J :]
        p, p_b = (frexp(max(map(abs, values)))[1] for values in (W, b))
        n = min(15 - p, 50 - p_b - a, 24)
        W, b, a = [round(ldexp(w, n)) for w in W], [round(ldexp(v, a + n)) for v in b], a + n
        x = [sum(map(int.__mul__, x, W[j::J])) + b[j] for j in range(J)]
        B = X * max(sum(map(abs, W[j::J])) for j in range(J)) + max(map(abs, b))
    return x, a, B


def hash_feature(place, h, grids):
    feature = []
    for (axes, R), grid in zip(h["grid"], grids):
        n, F, v = [place["xyz".index(axis)] * (R - 1) for axis in axes], h["F"], [0] * h["F"]
        for corner in product((0, 1), repeat=len(n)):
            weight = prod(u % 65535 if step else 65535 - u % 65535 for u, step in zip(n, corner))
            node = [min(u // 65535 + step, R - 1) for u, step in zip(n, corner)]
            row = sum(i * R**j for j, i in enumerate(node))
            if R ** len(n) * F > len(grid):  # the products pass 2^53; only their low 32 bits count
                x, y, z = map(int.__mul__, (*node, 0)[:3], (1, 2654435761, 805459861))
                row = (x ^ y ^ z) % 2**32 % (len(grid) // F)
            v = [total + weight * sign for total, sign in zip(v, grid[row * F : row * F + F])]
        feature += [(total + (65535 ** len(n) >> 16)) // (65535 ** len(n) >> 15) for total in v]
    return feature


def context(
    place, h, grids, widths, psi_p, psi_q
):  # h, q_units of the groups, mu_units and sigma_units
    q_units, mu_units, sigma_units, at, sigmoid, log2 = (
        [],
        [],
        [],
        0,
        TABLES["sigmoid"],
        TABLES["log2"],
    )
    feature = hash_feature(place, h, grids)
    (u, a_q, _), (y, a, B) = run_network(feature, *psi_q), run_network(feature, *psi_p)
    t = max(0, B.bit_length() - 28)
    for group, width in enumerate(widths):
        i, r = divmod(
            clip(clip(halve(u[group], a_q - 12), -(2**15), 2**15) + 4 * 2**12, 0, 10 * 2**12 - 1),
            64,
        )
        q_units.append(
            clip(sigmoid[i] + ((sigmoid[i + 1] - sigmoid[i]) * r >> 6) + 128 >> 8, 32, 65536)
        )
        f, p = frexp(h["Q_0"][group])
        D = int(f * 2**24) * q_units[-1]
        n = D.bit_length() - 24
        i, r = divmod((D >> n) - 2**23, 2**15)
        log2_D = (n + 23) * 2**16 + log2[i] + ((log2[i + 1] - log2[i]) * r >> 15)
        for mu, raw in zip(y[at : at + width], y[at + width : at + 2 * width]):
            mu_units.append(
                clip(halve(halve(mu, t) * (2**47 // (D >> n)), a - t + p + n - 2), -(2**34), 2**34)
            )
            log2_sigma = clip(halve(raw, a - 16), -14 * 2**16, 6 * 2**16) * 94548 + 2**15 >> 16
            sigma_units.append(
                clip(log2_sigma - log2_D - (p - 39) * 2**16 + 2**11 >> 12, -128, 319)
            )
        at += 2 * width
    return feature, q_units, mu_units, sigma_units


def read_message(
    data, at, tables, section
):  # tables: (cum, how many entries) of each symbol; entries, offset behind
    first = data[at] if len(data) > at else 0
    lanes, high, m = 1 << (first & 15), first >> 7, int.from_bytes(data[at + 1 : at + 5], "little")
    start, rows = (at + 9 + 4 * high, len(tables) - m) if lanes > 1 else (at + 5 + 4 * high, 0)
    states = [
        int.from_bytes(data[start - 4 - 4 * high : start], "little")
    ]  # all states pass 2^53, up to 2^63
    need(len(data) >= start and first & 0x70 == 0 and lanes <= 1024, section, "head of the message")
    need(
        0 <= rows < len(tables) and rows % lanes == 0 and 2 ** (31 + high) <= states[0] < 2**63,
        section,
        "tail or state",
    )
    words = [
        word
        for (word,) in struct.iter_unpack("<I", data[start : len(data) - (len(data) - start) % 4])
    ][::-1]
    end, entries = start + 4 * len(words), []

    def refill(lane, x, popped):
        need(x >= 2**31 or words, section, "end of the data")
        states[lane] = x if x >= 2**31 else x << 32 | words.pop()
        return popped

    for _ in range(1, lanes):
        n = refill(0, *divmod(states[0], 2**5))
        states.append(
            (2**n + refill(0, *divmod(states[0], 2**n)) << 31)
            + refill(0, *divmod(states[0], 2**31))
        )
    for i, (cum, count) in enumerate(tables):
        for state in states[:0:-1] if i == rows else ():  # between rows and tail the lanes end
            need(state >> 31 == 1, section, "end of a lane")
            high, low = divmod(states[0], 2**32)
            words += [low] if high else []
            states[0] = (high or low) << 31 | state - 2**31
        lane = i % lanes if i < rows else 0
        high, slot = divmod(states[lane], 2**24)
        entry = bisect_right(range(1, count), slot, key=cum)
        entries.append(
            refill(lane, high * (cum(entry + 1) - cum(entry)) + slot - cum(entry), entry)
        )
    need(states[0] == 2**31, section, "end of lane 0")
    return entries, end - 4 * len(words)


def read_bits(data, count, section):
    f = int.from_bytes(data[:4], "little")
    need(len(data) >= 4 and f <= 2**24, section, "probability")
    bits, end = [f >> 24] * count, 4
    if 0 < f < 2**24:
        bits, end = read_message(data, 4, [((0, 2**24 - f, 2**24).__getitem__, 2)] * count, section)
    need(end == len(data), section, "bytes left over")
    return bits


def gaussian(mu, sigma):  # cum of a symbol's table, 2W + 1, the first block, the number of raw bits
    e, scale = sigma >> 4, TABLES["exp2"][sigma & 15]
    step, low, W = max(e + 6, 0), max(e - 4, 0), 1 + ceil(12 * 2.0 ** min(e, 4))
    mu = halve(mu, step) << step
    lowest, n = (mu + 512 >> 10 + low) - W, 2 * W + 1

    def cum(j):
        z = clip(((lowest + j << 10 + low) - 512 - mu) * scale >> 12 + e, -98304, 98303) + 98304
        below, above = TABLES["phi"][z >> 8 : (z >> 8) + 2]
        return ((below + ((above - below) * (z & 255) >> 8)) * (2**24 - n - 1) >> 24) + j

    return cum, n, lowest, low


def read_gaussian(data, pairs, section):
    models, symbols = [gaussian(mu, sigma) for mu, sigma in pairs], []
    entries, at = (
        read_message(data, 0, [(m[0], m[1] + 1) for m in models], section) if models else ([], 0)
    )
    raw = [byte >> i & 1 for byte in data[at:] for i in range(8)][::-1]

    def take(width):
        need(len(raw) >= width, section, "raw bits")
        return sum(raw.pop() << i for i in range(width))

    for (_, n, lowest, low), entry, bits in zip(models, entries, [take(low) for *_, low in models]):
        if entry == n:  # the escape
            b = next(
                (b for b in range(34) if take(1)), 34
            )  # 34 makes a symbol that is refused below
            v = 2**b + take(b)
            entry = n + v // 2 if v % 2 else -v // 2
        symbols.append((lowest + entry << low) + bits)
    need(
        len(raw) < 8 and not any(raw) and all(abs(symbol) <= 2**31 for symbol in symbols),
        section,
        "rest or symbol",
    )
    return symbols


def decode(data):  # every array of the file, flat, row by row
    sections = read_container(data)
    h, T, widths = read_header(sections["header"])
    numbers, networks = read_networks(sections, h, widths)
    body, A, k, n = sections["positions"], h["anchors"], h["k"], sum(widths)
    need(len(body) == 24 + 6 * A, "positions", "length")
    box, positions = struct.unpack("<6f", body[:24]), struct.unpack(f"<{3 * A}H", body[24:])
    need(all(-1e30 <= lo <= hi <= 1e30 for lo, hi in zip(box, box[3:])), "positions", "box")
    masks = read_bits(sections["masks"], A * k, "masks")
    signs = [2 * bit - 1 for bit in read_bits(sections["hash_grid"], sum(T) * h["F"], "hash_grid")]
    grids = [signs[(end - t) * h["F"] : end * h["F"]] for t, end in zip(T, accumulate(T))]
    contexts = [
        context(positions[3 * a : 3 * a + 3], h, grids, widths, *networks) for a in range(A)
    ]
    features, q_units, mu_units, sigma_units = (sum(part, []) for part in zip(*contexts))
    q = [units * (h["Q_0"][i % 4] * 2.0**-15) for i, units in enumerate(q_units)]
    group, symbols = [g for g, width in enumerate(widths) for _ in range(width)] * A, [0] * (A * n)
    for g, name in enumerate(SECTIONS[2:6]):
        where = [
            i
            for i in range(A * n)
            if group[i] == g and (g < 3 or masks[i // n * k + (i % n + 3 * k - n) // 3])
        ]
        pairs = [(mu_units[i], sigma_units[i]) for i in where]
        for i, symbol in zip(where, read_gaussian(sections[name], pairs, name)):
            symbols[i] = symbol
    return {
        "header": h,
        "positions": positions,
        "masks": masks,
        "signs": signs,
        "h": features,
        "q": q,
        "q_units": q_units,
        "mu_units": mu_units,
        "sigma_units": sigma_units,
        "symbols": symbols,
        "attributes": [symbol * q[i // n * 4 + group[i]] for i, symbol in enumerate(symbols)],
        **numbers,
        "x_a": [
            lo + u * ((hi - lo) / 65535) for u, lo, hi in zip(positions, box[:3] * A, box[3:] * A)
        ],
    }
