"""Pairs of floats in C: the unevaluated sum of two, some 46 bits, where hardware knows float alone.

Sums and products are those of Dekker, "A floating-point technique for extending the available
precision" (1971), with the two-sum of Knuth; the product of matrices is compensated as by Ogita,
Rump and Oishi, "Accurate sum and dot product" (2005). Functions are series of which the first
terms are pairs, or a step of Newton from the float: to 3e-10 where a float has 6e-8. Numbers are
those that a float can have (up to 3e38); sine and cosine are known to 4 million rad.
"""

import math

import numpy as np

__all__ = ["FORMS", "HELPERS", "halves", "text"]


FORMS = {
    "add": "{p}_add({0}, {1})", "sub": "{p}_add({0}, {p}_neg({1}))", "mul": "{p}_mul({0}, {1})",
    "div": "{p}_div({0}, {1})", "rem": "{p}_rem({0}, {1})", "neg": "{p}_neg({0})",
    "abs": "{0}.h < 0 ? {p}_neg({0}) : {0}",
    "sign": "{0}.h != {0}.h ? {0} : {p}_pair((float)(({0}.h > 0) - ({0}.h < 0)), 0.0f)",
    "max": "({p}_less({1}, {0}) || {0}.h != {0}.h) ? {0} : {1}",
    "min": "({p}_less({0}, {1}) || {0}.h != {0}.h) ? {0} : {1}",
    "sure max": "{p}_less({1}, {0}) ? {0} : {1}", "sure min": "{p}_less({0}, {1}) ? {0} : {1}",
    "floor": "{p}_floor({0})", "ceil": "{p}_neg({p}_floor({p}_neg({0})))",
    "round": "{p}_round({0})", "finite": "{0}.h - {0}.h == 0", "lt": "{p}_less({0}, {1})",
    "gt": "{p}_less({1}, {0})", "le": "{p}_less({0}, {1}) || {p}_same({0}, {1})",
    "ge": "{p}_less({1}, {0}) || {p}_same({0}, {1})", "eq": "{p}_same({0}, {1})",
    "ne": "!{p}_same({0}, {1})", "int": "{p}_int({0})", "bool": "{0}.h != 0",
    "from int": "{p}_whole({0})", "sqrt": "{p}_sqrt({0})", "exp": "{p}_exp({0})",
    "log": "{p}_log({0})", "sin": "{p}_sine({0}, 0)", "cos": "{p}_sine({0}, 1)",
    "tanh": "{p}_tanh({0})", "atan": "{p}_atan({0})",
}  # fmt: skip
_HELPERS = {
    "_pair": """
        /* The sum of h and a smaller l; of an h that is not finite, h. */
        static inline {p}_real {p}_pair(float h, float l)
        {
            {p}_real a;
            a.h = h + l;
            a.l = l - (a.h - h);
            if (!(a.h - a.h == 0)) a.h = h, a.l = 0;
            return a;
        }
    """,
    "_error": """
        /* a b - c where c is a b rounded: exact. */
        static inline float {p}_error(float a, float b, float c)
        {
        #if defined FP_FAST_FMAF || defined __FP_FAST_FMAF
            return fmaf(a, b, -c);
        #else
            const float s = 4097.0f * a, t = 4097.0f * b, ah = s - (s - a), bh = t - (t - b);
            const float al = a - ah, bl = b - bh;
            return ((ah * bh - c) + ah * bl + al * bh) + al * bl;
        #endif
        }
    """,
    "_rest": """
        /* a - b q, exact where q is a / b rounded. */
        static inline float {p}_rest(float a, float b, float q)
        {
        #if defined FP_FAST_FMAF || defined __FP_FAST_FMAF
            return fmaf(-q, b, a);
        #else
            const float c = q * b;
            return (a - c) - {p}_error(q, b, c);
        #endif
        }
    """,
    "_neg": """
        static inline {p}_real {p}_neg({p}_real a)
        {
            a.h = -a.h, a.l = -a.l;
            return a;
        }
    """,
    "_less": """
        static inline int {p}_less({p}_real a, {p}_real b)
        {
            return a.h < b.h || (a.h == b.h && a.l < b.l);
        }
    """,
    "_same": """
        static inline int {p}_same({p}_real a, {p}_real b)
        {
            return a.h == b.h && a.l == b.l;
        }
    """,
    "_add": """
        static inline {p}_real {p}_add({p}_real a, {p}_real b)
        {
            const float s = a.h + b.h, v = s - a.h;
            return {p}_pair(s, ((a.h - (s - v)) + (b.h - v)) + (a.l + b.l));
        }
    """,
    "_mul": """
        static inline {p}_real {p}_mul({p}_real a, {p}_real b)
        {
            const float c = a.h * b.h;
            return {p}_pair(c, {p}_error(a.h, b.h, c) + (a.h * b.l + a.l * b.h));
        }
    """,
    "_plus": """
        /* s + a w, where s is a sum that is not yet a pair. */
        static inline {p}_real {p}_plus({p}_real s, {p}_real a, float w)
        {
            const float c = a.h * w, h = s.h + c, v = h - s.h;
            s.l += ((s.h - (h - v)) + (c - v)) + ({p}_error(a.h, w, c) + a.l * w);
            s.h = h;
            return s;
        }
    """,
    "_div": """
        static inline {p}_real {p}_div({p}_real a, {p}_real b)
        {
            const float q = a.h / b.h;
            return {p}_pair(q, ({p}_rest(a.h, b.h, q) + (a.l - q * b.l)) / b.h);
        }
    """,
    "_below": """
        static inline float {p}_below(float a)
        {
            if (!(a < 8388608.0f && a > -8388608.0f)) return a;
            const float n = (float)(int)a;
            return n > a ? n - 1.0f : n;
        }
    """,
    "_floor": """
        static inline {p}_real {p}_floor({p}_real a)
        {
            const float n = {p}_below(a.h);
            return {p}_pair(n, n == a.h ? {p}_below(a.l) : 0.0f);
        }
    """,
    "_round": """
        /* Halves to even. */
        static inline {p}_real {p}_round({p}_real a)
        {
            const {p}_real n = {p}_floor(a), half = {p}_mul(n, {p}_pair(0.5f, 0.0f));
            const {p}_real rest = {p}_add({p}_add(a, {p}_neg(n)), {p}_pair(-0.5f, 0.0f));
            const int up = rest.h > 0 || (rest.h == 0 && !{p}_same(half, {p}_floor(half)));
            return up ? {p}_add(n, {p}_pair(1.0f, 0.0f)) : n;
        }
    """,
    "_int": """
        /* Towards zero, at most what an int holds; 0 of NaN. */
        static inline int {p}_int({p}_real a)
        {
            const {p}_real n = {p}_floor(a.h < 0 ? {p}_neg(a) : a);
            if (n.h != n.h) return 0;
            if (!(n.h < 2147483648.0f)) return a.h < 0 ? -2147483647 - 1 : 2147483647;
            return a.h < 0 ? -(int)n.h - (int)n.l : (int)n.h + (int)n.l;
        }
    """,
    "_whole": """
        static inline {p}_real {p}_whole(int n)
        {
            return {p}_pair((float)(n / 4096 * 4096), (float)(n % 4096));
        }
    """,
    "_rem": """
        static inline {p}_real {p}_rem({p}_real a, {p}_real b)
        {
            const {p}_real size = a.h < 0 ? {p}_neg(a) : a, d = b.h < 0 ? {p}_neg(b) : b;
            const float turns = {p}_div(size, d).h;
            if (turns < 1.0f && {p}_less(size, d)) return a;
            if (!(turns < 4194304.0f)) return {p}_pair(NAN, 0.0f);
            const {p}_real n = {p}_pair({p}_below(turns), 0.0f);
            {p}_real rest = {p}_add(size, {p}_neg({p}_mul(n, d)));
            if (rest.h < 0) rest = {p}_add(rest, d);
            if (!{p}_less(rest, d)) rest = {p}_add(rest, {p}_neg(d));
            return a.h < 0 ? {p}_neg(rest) : rest;
        }
    """,
    "_sqrt": """
        static inline {p}_real {p}_sqrt({p}_real a)
        {
            const float s = sqrtf(a.h);
            if (!(s > 0 && s - s == 0)) return {p}_pair(s, 0.0f);
            return {p}_pair(s, ({p}_rest(a.h, s, s) + a.l) / (s + s));
        }
    """,
    "_exp": """
        /* 2^n exp(r) with |r| < 0.35: the first terms of the series as pairs. */
        static inline {p}_real {p}_exp({p}_real a)
        {
            union { int i; float f; } scale;
            if (!(a.h < 88.72f)) return {p}_pair(a.h != a.h ? a.h : INFINITY, 0.0f);
            if (a.h < -86.5f) return {p}_pair(0.0f, 0.0f);
            const float n = {p}_below(1.44269504f * a.h + 0.5f);
            {p}_real r = {p}_mul({p}_pair(n, 0.0f), {p}_pair(<LN2>));
            r = {p}_add({p}_pair(a.h - n * 0.693359375f, a.l), r);
            const float t = r.h, last = t * (t * 2.75573192e-6f + 2.48015873e-5f) + 1.98412698e-4f;
            const float few = t * (t * last + 1.38888889e-3f) + 8.33333333e-3f;
            const {p}_real z = {p}_mul(r, r);
            {p}_real y = {p}_mul({p}_mul(z, r), {p}_pair(<1/6>));
            y = {p}_add(y, {p}_pair(z.h * z.h * (t * few + 4.16666667e-2f), 0.0f));
            y = {p}_add(y, {p}_mul(z, {p}_pair(0.5f, 0.0f)));
            y = {p}_add({p}_pair(1.0f, 0.0f), {p}_add(r, y));
            scale.i = ((int)n + 126) * 8388608;
            return {p}_pair(2.0f * (y.h * scale.f), 2.0f * (y.l * scale.f));
        }
    """,
    "_log": """
        static inline {p}_real {p}_log({p}_real a)
        {
            const float y = logf(a.h);
            if (!(y - y == 0)) return {p}_pair(y, 0.0f);
            const {p}_real root = {p}_exp({p}_pair(-0.5f * y, 0.0f));
            const {p}_real ratio = {p}_mul({p}_mul(a, root), root);
            return {p}_add({p}_pair(y, 0.0f), {p}_add(ratio, {p}_pair(-1.0f, 0.0f)));
        }
    """,
    "_tanh": """
        static inline {p}_real {p}_tanh({p}_real a)
        {
            const {p}_real one = {p}_pair(1.0f, 0.0f), b = a.h < 0 ? a : {p}_neg(a);
            if (a.h != a.h) return a;
            const {p}_real e = {p}_exp({p}_pair(2.0f * b.h, 2.0f * b.l));
            const {p}_real y = {p}_div({p}_add(one, {p}_neg(e)), {p}_add(one, e));
            return a.h < 0 ? {p}_neg(y) : y;
        }
    """,
    "_sine": """
        /* Sine of a and some quarter turns; the first terms of the series as pairs. */
        static inline {p}_real {p}_sine({p}_real a, int quarters)
        {
            if (!(a.h < 4194304.0f && a.h > -4194304.0f)) return {p}_pair(NAN, 0.0f);
            const float n = {p}_below(0.636619772f * a.h + 0.5f);
            const {p}_real turned = {p}_mul({p}_pair(n, 0.0f), {p}_pair(<PI/2>));
            const {p}_real r = {p}_add(a, {p}_neg(turned)), z = {p}_mul(r, r);
            const float t = z.h;
            {p}_real y;
            quarters += (int)n;
            if (quarters & 1) {
                y.h = t * (t * (t * 2.08767570e-9f - 2.75573192e-7f) + 2.48015873e-5f);
                y = {p}_pair(<1/24> + t * (y.h - 1.38888889e-3f));
                y = {p}_add({p}_pair(-0.5f, 0.0f), {p}_mul(z, y));
                y = {p}_add({p}_pair(1.0f, 0.0f), {p}_mul(z, y));
            } else {
                y.h = t * (t * (t * 1.60590438e-10f - 2.50521084e-8f) + 2.75573192e-6f);
                y = {p}_pair(<1/120> + t * (y.h - 1.98412698e-4f));
                y = {p}_add({p}_pair(<-1/6>), {p}_mul(z, y));
                y = {p}_add(r, {p}_mul({p}_mul(z, r), y));
            }
            return quarters & 2 ? {p}_neg(y) : y;
        }
    """,
    "_atan": """
        static inline {p}_real {p}_atan({p}_real a)
        {
            const {p}_real y = {p}_pair(atanf(a.h), 0.0f);
            if (!(a.h - a.h == 0)) return y;
            const {p}_real s = {p}_sine(y, 0), c = {p}_sine(y, 1);
            const {p}_real off = {p}_add({p}_mul(a, c), {p}_neg(s));
            return {p}_add(y, {p}_div(off, {p}_add(c, {p}_mul(a, s))));
        }
    """,
}

# Numbers in them, as both floats of a pair. Of ln 2 it is what 0.693359375 n leaves of it.
_CONSTANTS = {
    "LN2": 0.693359375 - math.log(2), "PI/2": math.pi / 2, "1/6": 1 / 6, "-1/6": -1 / 6,
    "1/24": 1 / 24, "1/120": 1 / 120,
}  # fmt: skip


def text(value: np.ndarray) -> str:
    """A float or double as C writes it."""
    number = value.item()
    if not np.isfinite(number):
        return "NAN" if number != number else f"{'-' if number < 0 else ''}INFINITY"
    text = str(value.dtype.type(number))
    text = text if "." in text or "e" in text else f"{text}.0"
    return f"{text}f" if value.dtype == np.float32 else text


def halves(value: np.ndarray) -> tuple[str, str]:
    """A number as two floats, the second of which is the rounding error of the first."""
    with np.errstate(over="ignore"):
        high = value.astype("f4")
    low = value - high if np.isfinite(high) else np.zeros(())
    return text(high), text(np.asarray(low, "f4"))


def _written(code: str) -> str:
    for name, value in _CONSTANTS.items():
        code = code.replace(f"<{name}>", ", ".join(halves(np.asarray(value))))
    return code


HELPERS = {name: _written(code) for name, code in _HELPERS.items()}
