/* The exponential of a small matrix, by scaling and squaring with Taylor's polynomial of degree 16
   (Higham, Functions of Matrices, 2008, ch. 10).

   The number of halvings follows from norms of powers of the matrix (Al-Mohy and Higham, SIAM J.
   Matrix Anal. Appl. 31(3), 2009, theorem 4.2): a large input matrix beside small dynamics is not
   scaled too much, which would cost accuracy. */
#include <math.h>
#include <string.h>

#include "loop.h"

enum { DEGREE = 16 };

/* Up to this alpha the polynomial is the exponential of a matrix that differs by less than 2^-53 of
   its norm (Al-Mohy and Higham, SIAM J. Sci. Comput. 33(2), 2011, table 3.1). */
static const double LARGEST_ALPHA = 0.78;

/* The 1-norm (largest absolute column sum); NaN if an entry is NaN. */
static double one_norm(int64_t n, const double *matrix) {
    double largest = 0.0;
    for (int64_t j = 0; j < n; j++) {
        double total = fabs(matrix[j]);
        for (int64_t i = 1; i < n; i++)
            total += fabs(matrix[i * n + j]);
        if (!(total <= largest))
            largest = total;
        if (isnan(largest))
            return largest;
    }
    return largest;
}

/* How often to halve a norm until it is at most a limit. */
static int halvings(double norm, double limit) {
    if (!(0.0 < norm && norm < INFINITY))
        return 0;
    int exponent;
    double mantissa = frexp(norm / limit, &exponent);
    exponent -= mantissa == 0.5;
    return exponent > 0 ? exponent : 0;
}

static void scale(int64_t size, double *matrix, int exponent) {
    for (int64_t k = 0; k < size; k++)
        matrix[k] = ldexp(matrix[k], exponent);
}

/* result += factor matrix */
static void add(int64_t size, double factor, const double *matrix, double *result) {
    for (int64_t k = 0; k < size; k++)
        result[k] += factor * matrix[k];
}

/* Taylor's polynomial from M, M^2, M^3 and M^4 (Paterson and Stockmeyer, 1973). */
static void polynomial(int64_t n, double *const powers[4], double *result, double *other) {
    double terms[DEGREE + 1], factorial = 1.0;
    int64_t size = n * n;
    for (int k = 0; k <= DEGREE; k++) {
        factorial *= k > 0 ? k : 1;
        terms[k] = 1.0 / factorial;
    }
    for (int64_t k = 0; k < size; k++)
        result[k] = terms[DEGREE] * powers[3][k];
    for (int k = DEGREE - 4; k >= 0; k -= 4) {
        if (k < DEGREE - 4) {
            noack_multiply(n, n, n, result, powers[3], 0, other);
            memcpy(result, other, (size_t)size * sizeof *result);
        }
        for (int j = 3; j > 0; j--)
            add(size, terms[k + j], powers[j - 1], result);
        for (int64_t i = 0; i < n; i++)
            for (int64_t j = 0; j < n; j++)
                result[i * n + j] += i == j ? terms[k] : 0.0;
    }
}

void noack_exponential(int64_t n, const double *matrix, double *result, double *scratch) {
    int64_t size = n * n;
    double *powers[4] = {scratch, scratch + size, scratch + 2 * size, scratch + 3 * size};
    double *other = scratch + 4 * size;
    /* Scaled to a norm of at most 1 first: its powers do not overflow. */
    int norm_halvings = halvings(one_norm(n, matrix), 1.0);
    for (int64_t k = 0; k < size; k++)
        powers[0][k] = ldexp(matrix[k], -norm_halvings);
    noack_multiply(n, n, n, powers[0], powers[0], 0, powers[1]);
    noack_multiply(n, n, n, powers[1], powers[0], 0, powers[2]);
    noack_multiply(n, n, n, powers[1], powers[1], 0, powers[3]);
    double cube = noack_cube_root(one_norm(n, powers[2]));
    double fourth = sqrt(sqrt(one_norm(n, powers[3])));
    double alpha = fourth > cube ? fourth : cube;
    int further_halvings = halvings(ldexp(alpha, norm_halvings), LARGEST_ALPHA) - norm_halvings;
    for (int k = 0; k < 4; k++)
        scale(size, powers[k], -further_halvings * (k + 1));
    polynomial(n, powers, result, other);
    for (int k = 0; k < norm_halvings + further_halvings; k++) {
        noack_multiply(n, n, n, result, result, 0, other);
        memcpy(result, other, (size_t)size * sizeof *result);
    }
}
