"""A decoder of model files in plain Python, written from the format page alone.

It shares no code with `p4dgs_ref/codec`. It refuses a file by ValueError(section or "container",
reason). Comments say where a port whose numbers are doubles must take care of integers above 2^53.
"""

import json
import struct
import zlib
from bisect import bisect_right
from itertools import accumulate, product
from math import ceil, frexp, isfinite, ldexp, prod
from pathlib import Path

FILE = Path(__file__).resolve().parents[2] / "p4dgs_ref" / "codec" / "tables.json"
TABLES = json.loads(FILE.read_text(encoding="utf-8"))
SECTIONS = (
    "header",
    "positions",
    "features",
    "scales",
    "offset_scales",
    "offsets",
    "masks",
    "hash_grid",
    "deformation_mlp",
    "anchor_mlps",
    "context_mlps",
)
HEADS = {"translation": 3, "scaling": 3, "rotation": 4}  # outputs of psi_d for each effect
EFFECTS = {*HEADS, "view_color", "view_geometry", "occlusion", "background"}
PRIMES = (1, 2654435761, 805459861)
WIDTHS = (1, 2**14, range(9))
RANGES = {  # of a number of the header; of the numbers of a list, and how many it may have
    "anchors": (1, 2**22),
    "background": (-(2**20), 2**20, [3]),
    "d": (1, 4096),
    "k": (1, 256),
    "hidden": WIDTHS,
    "deformation": WIDTHS,
    "L_x": (1, 64),
    "L_t": (1, 64),
    "context": WIDTHS,
    "grid": (1, 2**16, range(1, 65)),
    "table": (1, 2**24, [2]),
    "F": (1, 64),
    "Q_0": (2.0**-100, 2.0**100, [4]),
    "tau_alpha": (0, 1),
}


def need(holds, section, reason):
    """Refuse the file unless a condition holds."""
    if not holds:
        raise ValueError(section, reason)


def clip(value, least, most):
    return max(least, min(value, most))


def halve(y, s):
    """y / 2^s rounded to the nearest integer, ties up; y 2^-s for s < 0, where ports must clip."""
    if s < 0:
        return y << min(-s, 64)
    return y + (1 << s >> 1) >> s


def interpolate(table, i, r, bits):
    """table[i] + floor((table[i + 1] - table[i]) r / 2^bits)"""
    return table[i] + ((table[i + 1] - table[i]) * r >> bits)


def read_container(data):
    """The sections {name: bytes} of a file."""
    valid = len(data) >= 18 and data[:9] == b"\x89P4D\r\n\x1a\n\x01"
    need(valid, "container", "size, magic or version")
    start = 18 + 9 * data[9]
    total = int.from_bytes(data[10:14], "little")
    crc = zlib.crc32(data[: start - 4]).to_bytes(4, "little")
    valid = start <= total == len(data) and crc == data[start - 4 : start]
    need(valid, "container", "total length or checksum")
    rows = list(struct.iter_unpack("<BII", data[14 : start - 4]))
    ids = [number for number, _, _ in rows]
    lengths = [length for _, length, _ in rows]
    need(ids == sorted({*ids} & {*range(1, 12)}), "container", "ids")
    need(start + sum(lengths) == total, "container", "lengths")
    sections = {}
    for number, length, crc in rows:
        body = data[start : start + length]
        need(zlib.crc32(body) == crc, SECTIONS[number - 1], "checksum")
        sections[SECTIONS[number - 1]] = body
        start += length
    for name in SECTIONS:
        need(name in sections or name == "deformation_mlp", name, "missing")
    return sections


def read_header(body, size):
    """The fields, the nodes T of each level, and the widths of the groups f, s, l, O.

    `size` is the number of bytes of all sections.
    """
    try:
        h = json.loads(body.decode("ascii"))
        resolutions = [R for _, R in h["grid"]]
        for name, (least, most, *counts) in RANGES.items():
            values = resolutions if name == "grid" else h[name] if counts else [h[name]]
            need(not counts or len(values) in counts[0], "header", f"{name}: length")
            need(all(least <= float(v) <= most for v in values), "header", f"{name}: range")
        T = [min(R ** len(axes), h["table"][len(axes) == 2]) for axes, R in h["grid"]]
        entries = h["F"] * sum(T)
        numbers = h["anchors"] * (9 + h["d"] + 4 * h["k"]) + entries  # without the weights
        most = min(2**25, 2**22 + 16 * size)
        need(0 < entries <= 2**24 and 0 < numbers <= most, "header", "sizes")
        need({*h["effects"]} <= EFFECTS, "header", "effects")
        widths = [h["d"], 3, 3, 3 * h["k"]]
        nets = [(len(T) * h["F"], *h["context"], n) for n in (2 * sum(widths), 4)]
        work = sum(I * J for net in nets for I, J in zip(net, net[1:]))
        work += sum(2 ** len(axes) * 64 * (h["F"] + 8) for axes, _ in h["grid"])
        need(h["anchors"] * work <= 2**34 + 2**15 * size, "header", "work")
        return h, T, widths
    except (LookupError, OverflowError, TypeError, ValueError, RecursionError) as error:
        raise ValueError("header", "a field that is missing, unknown or out of range") from error


def read_networks(sections, h, widths):
    """The numbers of every section {name: numbers}, and (widths, numbers) of psi_p and psi_q."""
    geometry = h["d"] + 4 * ("view_geometry" in h["effects"])
    color = h["d"] + 4 * ("view_color" in h["effects"])
    outputs = ((geometry, 1), (color, 3), (geometry, 4), (geometry, 3))  # per child
    features = len(h["grid"]) * h["F"]
    nets = {
        "anchor_mlps": [(inputs, *h["hidden"], n * h["k"]) for inputs, n in outputs],
        "context_mlps": [(features, *h["context"], n) for n in (2 * sum(widths), 4)],
    }
    layers = {
        name: [layer for net in of for layer in zip(net, net[1:])] for name, of in nets.items()
    }
    layers["deformation_mlp"] = layers_of_deformation(h)
    numbers = {}
    for name in layers:
        counts = [(I + 1) * J for I, J in layers[name]]
        body = sections.get(name, b"")
        need((name in sections) == bool(counts), name, "presence")
        need(len(body) == 2 * sum(counts), name, "length")
        numbers[name] = struct.unpack(f"<{sum(counts)}e", body)
        need(all(map(isfinite, numbers[name])), name, "a weight is not finite")
    of_psi_p, of_psi_q = nets["context_mlps"]
    end = sum((I + 1) * J for I, J in zip(of_psi_p, of_psi_p[1:]))
    context = numbers["context_mlps"]
    return numbers, (of_psi_p, context[:end]), (of_psi_q, context[end:])


def layers_of_deformation(h):
    """(inputs, outputs) of the layers of psi_d, whose heads are the last."""
    heads = [n for effect, n in HEADS.items() if effect in h["effects"]]
    if not heads:
        return []
    rows = [3 * (1 + 2 * h["L_x"]) + 1 + 2 * h["L_t"], *h["deformation"]]
    return [*zip(rows, rows[1:]), *((rows[-1], n) for n in heads)]


def run_network(x, widths, numbers):
    """The outputs of a network, their fractional bits a, and their bound B."""
    a, B, X = 15, 0, 2**15
    for layer, (I, J) in enumerate(zip(widths, widths[1:])):
        if layer:
            s = max(0, B.bit_length() - 22)
            x, a, X = [max(0, halve(y, s)) for y in x], a - s, halve(B, s)
        W, b = numbers[: I * J], numbers[I * J : (I + 1) * J]
        numbers = numbers[(I + 1) * J :]
        p, p_b = (frexp(max(map(abs, values)))[1] for values in (W, b))
        n = min(15 - p, 50 - p_b - a, 24)
        W, b = [round(ldexp(w, n)) for w in W], [round(ldexp(v, a + n)) for v in b]
        a += n
        columns = [W[j::J] for j in range(J)]
        x = [sum(map(int.__mul__, x, column)) + v for column, v in zip(columns, b)]
        B = X * max(sum(map(abs, column)) for column in columns) + max(map(abs, b))
    return x, a, B


def hash_feature(place, h, grids):
    """h of one position; `grids` holds the signs of every level."""
    feature, F = [], h["F"]
    for (axes, R), grid in zip(h["grid"], grids):
        T, D = len(grid) // F, len(axes)
        scaled = [place["xyz".index(axis)] * (R - 1) for axis in axes]
        sums = [0] * F
        for corner in product((0, 1), repeat=D):
            weights = [n % 65535 if c else 65535 - n % 65535 for n, c in zip(scaled, corner)]
            node = [min(n // 65535 + c, R - 1) for n, c in zip(scaled, corner)]
            row = sum(i * R**j for j, i in enumerate(node))
            if R**D > T:
                # The products exceed 2^53; only their low 32 bits count.
                x, y, z = map(int.__mul__, (*node, 0)[:3], PRIMES)
                row = (x ^ y ^ z) % 2**32 % T
            signs = grid[row * F : (row + 1) * F]
            sums = [total + prod(weights) * sign for total, sign in zip(sums, signs)]
        half, unit = 65535**D >> 16, 65535**D >> 15
        feature += [(total + half) // unit for total in sums]
    return feature


def context(place, h, grids, widths, psi_p, psi_q):
    """h, q_units of the four groups, mu_units and sigma_units of one anchor."""
    q_units, mu_units, sigma_units, at = [], [], [], 0
    feature = hash_feature(place, h, grids)
    steps, a_q, _ = run_network(feature, *psi_q)
    y, a, B = run_network(feature, *psi_p)
    t = max(0, B.bit_length() - 28)
    for width, step, Q_0 in zip(widths, steps, h["Q_0"]):
        u = clip(halve(step, a_q - 12), -(2**15), 2**15)
        i, r = divmod(clip(u + 4 * 2**12, 0, 10 * 2**12 - 1), 64)
        q_units.append(clip(interpolate(TABLES["sigmoid"], i, r, 6) + 128 >> 8, 32, 65536))
        f, p = frexp(Q_0)
        D = int(f * 2**24) * q_units[-1]
        n = D.bit_length() - 24
        R = 2**47 // (D >> n)
        i, r = divmod((D >> n) - 2**23, 2**15)
        log2_D = (n + 23) * 2**16 + interpolate(TABLES["log2"], i, r, 15)
        for mu in y[at : at + width]:
            m, S = halve(mu, t), a - t + p + n - 2
            mu_units.append(clip(halve(m * R, S), -(2**34), 2**34))
        for output in y[at + width : at + 2 * width]:
            raw = clip(halve(output, a - 16), -14 * 2**16, 6 * 2**16)
            log2_sigma = raw * 94548 + 2**15 >> 16
            units = log2_sigma - log2_D - (p - 39) * 2**16 + 2**11 >> 12
            sigma_units.append(clip(units, -128, 319))
        at += 2 * width
    return feature, q_units, mu_units, sigma_units


def read_message(data, at, tables, section):
    """The entries of a rANS message, and the offset of its end.

    `tables` has (cum, number of entries) for every symbol. All states exceed 2^53, up to 2^63.
    """
    first = data[at] if len(data) > at else 0
    lanes, high = 1 << (first & 15), first >> 7
    tail = int.from_bytes(data[at + 1 : at + 5], "little") if lanes > 1 else len(tables)
    size = 8 if high else 4
    start = at + 1 + 4 * (lanes > 1) + size
    valid = len(data) >= start and first & 0x70 == 0 and lanes <= 1024
    need(valid, section, "head of the message")
    rows = len(tables) - tail
    need(0 <= rows < len(tables) and rows % lanes == 0, section, "tail")
    states = [int.from_bytes(data[start - size : start], "little")]
    need(2 ** (31 + high) <= states[0] < 2**63, section, "state")
    count = (len(data) - start) // 4
    words = list(struct.unpack_from(f"<{count}I", data, start))[::-1]
    entries = []

    def refill(lane, x):
        """Set the state of a lane after a pop."""
        need(x >= 2**31 or words, section, "end of the data")
        states[lane] = x if x >= 2**31 else x << 32 | words.pop()

    def pop_bits(b):
        """Pop b bits from lane 0."""
        x, v = divmod(states[0], 2**b)
        refill(0, x)
        return v

    for _ in range(1, lanes):
        n = pop_bits(5)
        v = pop_bits(n)
        states.append((2**n + v << 31) + pop_bits(31))
    for i, (cum, size) in enumerate(tables):
        if i == rows:  # between rows and tail the other lanes end
            unread = len(words)
            for state in states[:0:-1]:
                need(state >> 31 == 1, section, "end of a lane")
                if states[0] >= 2**32:
                    words.append(states[0] % 2**32)
                    states[0] >>= 32
                states[0] = states[0] << 31 | state - 2**31
        lane = i % lanes if i < rows else 0
        x, slot = divmod(states[lane], 2**24)
        entry = bisect_right(range(1, size), slot, key=cum)
        entries.append(entry)
        refill(lane, x * (cum(entry + 1) - cum(entry)) + slot - cum(entry))
    need(states[0] == 2**31, section, "end of lane 0")
    need(len(words) <= unread, section, "a word that a lane gave back is left")
    return entries, start + 4 * (count - len(words))


def read_bits(data, count, section):
    """The bits of a bit stream."""
    f = int.from_bytes(data[:4], "little")
    need(len(data) >= 4 and f <= 2**24, section, "probability")
    if f in (0, 2**24):
        bits, end = [f >> 24] * count, 4
    else:
        table = ((0, 2**24 - f, 2**24).__getitem__, 2)
        bits, end = read_message(data, 4, [table] * count, section)
    need(end == len(data), section, "bytes left over")
    return bits


def gaussian(mu, sigma):
    """cum of a symbol's table, its blocks 2 W + 1, the first block, and the number of raw bits."""
    e, scale = sigma >> 4, TABLES["exp2"][sigma & 15]
    step, low, W = max(e + 6, 0), max(e - 4, 0), 1 + ceil(12 * 2.0 ** min(e, 4))
    mu = halve(mu, step) << step
    lowest, n = (mu + 512 >> 10 + low) - W, 2 * W + 1

    def cum(j):
        distance = (lowest + j << 10 + low) - 512 - mu
        z = clip(distance * scale >> 12 + e, -98304, 98303) + 98304
        C = interpolate(TABLES["phi"], z >> 8, z & 255, 8)
        return (C * (2**24 - n - 1) >> 24) + j

    return cum, n, lowest, low


def read_gaussian(data, pairs, section):
    """The symbols of a Gaussian stream, from (mu_units, sigma_units) of each."""
    models = [gaussian(mu, sigma) for mu, sigma in pairs]
    entries, at = [], 0
    if models:
        tables = [(cum, n + 1) for cum, n, _, _ in models]
        entries, at = read_message(data, 0, tables, section)
    raw = [byte >> i & 1 for byte in data[at:] for i in range(8)][::-1]

    def take(width):
        need(len(raw) >= width, section, "raw bits")
        return sum(raw.pop() << i for i in range(width))

    low_bits = [take(low) for _, _, _, low in models]
    symbols = []
    for (_, n, lowest, low), entry, bits in zip(models, entries, low_bits):
        if entry == n:  # the escape
            b = 0
            while not take(1):
                b += 1
                need(b <= 33, section, "an endless escape")
            v = 2**b + take(b)
            entry = n + v // 2 if v % 2 else -v // 2
        symbols.append((lowest + entry << low) + bits)
    need(len(raw) < 8 and not any(raw), section, "bits left over")
    need(all(abs(symbol) <= 2**31 for symbol in symbols), section, "a symbol beyond 2^31")
    return symbols


def decode(data):
    """Every array of a file, {name: flat list}, row by row."""
    sections = read_container(data)
    h, T, widths = read_header(sections["header"], sum(map(len, sections.values())))
    numbers, psi_p, psi_q = read_networks(sections, h, widths)
    A, k, n, F = h["anchors"], h["k"], sum(widths), h["F"]
    body = sections["positions"]
    need(len(body) == 24 + 6 * A, "positions", "length")
    box = struct.unpack("<6f", body[:24])
    lo, hi = box[:3], box[3:]
    need(all(-1e30 <= a <= b <= 1e30 for a, b in zip(lo, hi)), "positions", "box")
    positions = struct.unpack(f"<{3 * A}H", body[24:])
    steps = [(b - a) / 65535 for a, b in zip(lo, hi)]
    x_a = [lo[i % 3] + u * steps[i % 3] for i, u in enumerate(positions)]
    masks = read_bits(sections["masks"], A * k, "masks")
    signs = [2 * bit - 1 for bit in read_bits(sections["hash_grid"], sum(T) * F, "hash_grid")]
    grids = [signs[(end - t) * F : end * F] for t, end in zip(T, accumulate(T))]

    features, q_units, mu_units, sigma_units = [], [], [], []
    for a in range(A):
        place = positions[3 * a : 3 * a + 3]
        of_anchor = context(place, h, grids, widths, psi_p, psi_q)
        for whole, part in zip((features, q_units, mu_units, sigma_units), of_anchor):
            whole += part
    q = [units * (h["Q_0"][i % 4] * 2.0**-15) for i, units in enumerate(q_units)]

    symbols, attributes = [0] * (A * n), [0.0] * (A * n)
    start = 0  # the first column of the group
    for group, (name, width) in enumerate(zip(SECTIONS[2:6], widths)):
        where = [a * n + column for a in range(A) for column in range(start, start + width)]
        if name == "offsets":  # three of every child
            where = [i for child, i in enumerate(where) if masks[child // 3]]
        pairs = [(mu_units[i], sigma_units[i]) for i in where]
        for i, symbol in zip(where, read_gaussian(sections[name], pairs, name)):
            symbols[i] = symbol
        for i in range(A * n):
            if start <= i % n < start + width:
                attributes[i] = symbols[i] * q[i // n * 4 + group]
        start += width
    return {
        "header": json.loads(sections["header"]),
        "positions": positions,
        "x_a": x_a,
        "masks": masks,
        "signs": signs,
        "h": features,
        "q_units": q_units,
        "q": q,
        "mu_units": mu_units,
        "sigma_units": sigma_units,
        "symbols": symbols,
        "attributes": attributes,
        **numbers,
    }
