/* Functions of numpy that C does not have, for matrices in row-major order. */
#ifndef LINEAR_ALGEBRA_H
#define LINEAR_ALGEBRA_H

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

/* With -O3 and AVX, gcc 12.2 turned loops that copy into calls of memcpy, and one number of a state was wrong after
   them. The option below keeps the loops; clang does not know it. */
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("no-tree-loop-distribute-patterns")
#endif

enum { SWEEPS = 10 };        /* most sweeps of Jacobi rotations, which converge quadratically */
#define ORTHOGONAL 1e-32     /* cos² of the angle between two columns, below which they are not rotated */

static inline double square(double x) { return x * x; }
static inline double sign(double x) { return x == 0.0 ? 0.0 : x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : x; }
/* Without branches, for several entries at a time */
static inline double larger(double x, double y) { return (x >= y) | (x != x) ? x : y; }
static inline double smaller(double x, double y) { return (x <= y) | (x != x) ? x : y; }
static inline double modulo(double x, double y) { return x - y * floor(x / y); }

/* 2^n for a whole n, given as SHIFT + n: the last bits of such a sum are n. */
#define SHIFT 6755399441055744.0 /* 1.5 · 2^52 */
static inline double power_of_two(double shifted)
{
    const double one = 1.0;
    int64_t bits, exponent;
    double result;
    memcpy(&bits, &one, sizeof bits);
    memcpy(&exponent, &shifted, sizeof exponent);
    bits += (int64_t)((uint64_t)exponent << 52);
    memcpy(&result, &bits, sizeof result);
    return result;
}

/* e^x within 2 units in the last place, for several entries at a time: 2^n e^r with |r| <= ln(2) / 2. */
static inline double exponential(double x)
{
    const double above = x < -746.0 ? -746.0 : x;
    const double given = above > 710.0 ? 710.0 : above;
    const double n = (given * 1.4426950408889634 + SHIFT) - SHIFT;
    /* ln(2) in two parts; the product of n and the first one is exact */
    const double r = (given - n * 6.93147180369123816490e-01) - n * 1.90821492927058770002e-10;
    double series = 1.0 / 6227020800.0;
    series = series * r + 1.0 / 479001600.0;
    series = series * r + 1.0 / 39916800.0;
    series = series * r + 1.0 / 3628800.0;
    series = series * r + 1.0 / 362880.0;
    series = series * r + 1.0 / 40320.0;
    series = series * r + 1.0 / 5040.0;
    series = series * r + 1.0 / 720.0;
    series = series * r + 1.0 / 120.0;
    series = series * r + 1.0 / 24.0;
    series = series * r + 1.0 / 6.0;
    series = series * r + 0.5;
    /* In two halves, as 2^n may be out of range where the result is not */
    const double half = n * 0.5 + SHIFT;
    const double other = n - (half - SHIFT) + SHIFT;
    return (1.0 + (r + r * r * series)) * power_of_two(half) * power_of_two(other);
}

/* result = terms for i from 0 to n − 1, in partial sums, which do not wait for each other */
#define SUM(result, i, n, term)                                           \
    {                                                                     \
        enum { PARTS = (n) < 64 ? 4 : 8 };                                \
        double part[8] = {0.0};                                           \
        for (int first = 0; first + PARTS <= (n); first += PARTS)         \
            for (int lane = 0; lane < PARTS; lane++) {                    \
                const int i = first + lane;                               \
                part[lane] += (term);                                     \
            }                                                             \
        for (int i = (n) - (n) % PARTS; i < (n); i++) part[i % PARTS] += (term); \
        for (int lane = 4; lane < PARTS; lane++) part[lane - 4] += part[lane]; \
        result = (part[0] + part[2]) + (part[1] + part[3]);               \
    }

/* Rows of a table that numbers name. */
static inline void pick(int count, int width, const double *table, const double *rows, double *result)
{
    for (int k = 0; k < count; k++)
        for (int i = 0; i < width; i++) result[k * width + i] = table[(int)rows[k] * width + i];
}

/* Where the first of n numbers is that none exceeds. */
static inline void place_of_largest(int n, int columns, const double *x, double *place)
{
    int best = 0;
    for (int i = columns; i < n; i++)
        if (x[i] > x[best]) best = i;
    *place = best;
}

/* x = A⁻¹ b, (n, k), by Gaussian elimination with pivots; returns the determinant. Rows are not moved, as GCC 12 breaks that. */
static double eliminate(int n, int k, const double *A, const double *b, double *x)
{
    const int width = n + k;
    double rows[n * width], *row[n], product = 1.0;
    for (int i = 0; i < n; i++) {
        row[i] = rows + i * width;
        for (int c = 0; c < width; c++) row[i][c] = c < n ? A[i * n + c] : b[i * k + c - n];
    }
    for (int j = 0; j < n; j++) {
        int best = j;
        for (int i = j + 1; i < n; i++)
            if (fabs(row[i][j]) > fabs(row[best][j])) best = i;
        double *pivot = row[best];
        row[best] = row[j];
        row[j] = pivot;
        product *= best == j ? pivot[j] : -pivot[j];
        for (int i = j + 1; i < n; i++) {
            const double factor = row[i][j] / pivot[j];
            for (int c = j + 1; c < width; c++) row[i][c] -= factor * pivot[c];
        }
    }
    for (int i = n - 1; i >= 0; i--)
        for (int c = 0; c < k; c++) {
            double rest = row[i][n + c];
            for (int j = i + 1; j < n; j++) rest -= row[i][j] * x[j * k + c];
            x[i * k + c] = rest / row[i][i];
        }
    return product;
}

static void solve(int n, int k, const double *A, const double *b, double *x) { eliminate(n, k, A, b, x); }

static void determinant(int n, int columns, const double *A, double *result)
{
    *result = eliminate(columns, 0, A, A, result);
}

/* The lower factor, and behind it the least pivot, NaN if there is one. */
static void cholesky(int n, int columns, const double *A, double *L)
{
    double least = INFINITY;
    for (int j = 0; j < n; j++)
        for (int i = 0; i < n; i++) {
            double rest = A[i * columns + j];
            for (int k = 0; k < j && i >= j; k++) rest -= L[i * n + k] * L[j * n + k];
            if (i < j) rest = 0.0;
            if (i == j) least = smaller(rest, least);
            L[i * n + j] = i < j ? 0.0 : rest;
            if (i == j) L[i * n + i] = sqrt(rest);
            if (i > j) L[i * n + j] = rest / L[j * n + j];
        }
    L[n * n] = least;
}

static double dot(int n, const double *x, const double *y)
{
    double sum = 0.0;
    for (int i = 0; i < n; i++) sum += x[i] * y[i];
    return sum;
}

static void rotate(int n, double c, double s, double *x, double *y)
{
    for (int i = 0; i < n; i++) {
        const double one = c * x[i] - s * y[i];
        y[i] = s * x[i] + c * y[i];
        x[i] = one;
    }
}

/* One-sided Jacobi rotations of a tall matrix: Uᵀ (n, m), Vᵀ (n, n) and the singular values (n), the largest first. */
static void svd(int m, int n, const double *A, double *result)
{
    double U[n * m], V[n * n], values[n];
    for (int j = 0; j < n; j++) {
        for (int i = 0; i < m; i++) U[j * m + i] = A[i * n + j];
        for (int i = 0; i < n; i++) V[j * n + i] = i == j;
    }
    for (int sweep = 0, turned = 1; sweep < SWEEPS && turned; sweep++) {
        turned = 0;
        for (int p = 0; p < n; p++)
            for (int q = p + 1; q < n; q++) {
                double *one = U + p * m, *other = U + q * m;
                const double product = dot(m, one, other), a = dot(m, one, one), b = dot(m, other, other);
                if (product * product <= ORTHOGONAL * a * b) continue;
                /* t = tan of the angle, the smaller root of t² + 2 ζ t − 1 = 0 */
                const double zeta = (b - a) / (2.0 * product);
                const double t = (zeta >= 0.0 ? 1.0 : -1.0) / (fabs(zeta) + sqrt(1.0 + zeta * zeta));
                const double c = 1.0 / sqrt(1.0 + t * t);
                rotate(m, c, c * t, one, other);
                rotate(n, c, c * t, V + p * n, V + q * n);
                turned = 1;
            }
    }
    for (int j = 0; j < n; j++) values[j] = sqrt(dot(m, U + j * m, U + j * m));
    for (int j = 0; j < n; j++) {
        int rank = 0;
        for (int i = 0; i < n; i++) rank += values[i] > values[j] || (values[i] == values[j] && i < j);
        for (int i = 0; i < m; i++) result[rank * m + i] = values[j] > 0.0 ? U[j * m + i] / values[j] : 0.0;
        for (int i = 0; i < n; i++) result[n * m + rank * n + i] = V[j * n + i];
        result[n * m + n * n + rank] = values[j];
    }
    if (m == 3 && n == 3) {
        /* U is orthogonal also where the least value is only a rounding error. */
        const double *a = result, *b = result + 3;
        const double across[3] = {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
        const double side = dot(3, across, result + 6) < 0.0 ? -1.0 : 1.0;
        for (int i = 0; i < 3; i++) result[6 + i] = side * across[i];
    }
}

#endif
