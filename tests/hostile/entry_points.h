/*
 * What the driver of entry_points.py calls: numbers and arrays out of random bytes. All arrays are
 * of the heap, exactly as long as the header says, so that a sanitizer sees what goes beyond.
 */
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const uint8_t *bytes;
static size_t left;
static void *taken[64];
static int used;
static unsigned long calls, refusals, hostile_calls;

static unsigned byte(void)
{
    if (left == 0)
        return 0;
    left--;
    return *bytes++;
}

static int hostile; /* whether all numbers of this input are ordinary ones, or some are not */

/* A number as a user might give it; or one that nobody should. */
static double number(void)
{
    static const double odd[] = {
        0.0, -0.0, 1.0, -1.0, INFINITY, -INFINITY, NAN, DBL_MAX, -DBL_MAX, DBL_MIN, 4.9e-324, 1e-300,
        1e154, -1e155, 1e16, 1e300, 6755399441055744.0, 1e9, 3.141592653589793, -1.5707963267948966
    };
    unsigned kind = byte();
    double x;

    if (hostile && kind % 4 == 0)
        return odd[byte() % (sizeof odd / sizeof *odd)];
    if (hostile && kind % 4 == 1) {
        uint8_t raw[8];
        size_t k;

        for (k = 0; k < sizeof raw; k++)
            raw[k] = (uint8_t)byte();
        memcpy(&x, raw, sizeof x);
        return x;
    }
    x = (double)byte() + 256.0*(double)byte();
    return 4.0*(x/32768.0 - 1.0);
}

/* A step, a tolerance: small and positive, unless the input is hostile. */
static double small_number(void)
{
    return hostile && byte() % 2 == 0 ? number() : ldexp(1.0, -(int)(byte() % 40)) / 2;
}

static long up_to(long most)
{
    return (long)(byte() + 256u*byte()) % (most + 1);
}

static void *space(size_t size)
{
    void *made = calloc(1, size != 0 ? size : 1);

    if (made == NULL || used == (int)(sizeof taken / sizeof *taken))
        abort();
    return taken[used++] = made;
}

static REAL *given(long count)
{
    REAL *made = space((size_t)count*sizeof *made);
    long k;

    for (k = 0; k < count; k++)
        made[k] = (REAL)number();
    return made;
}

/* What is to be written: not a number, so that it is seen where it is not. */
static REAL *unwritten(long count)
{
    REAL *made = space((size_t)count*sizeof *made);

    memset(made, 0xff, (size_t)count*sizeof *made);
    return made;
}

static REAL *copied(const REAL *from, long count)
{
    REAL *made = space((size_t)count*sizeof *made);

    memcpy(made, from, (size_t)count*sizeof *made);
    return made;
}

static int finite_all(const REAL *x, long count)
{
    while (count-- > 0)
        if (!isfinite(x[count]))
            return 0;
    return 1;
}

static void broken(
    const char *function, const char *promise, int status, const REAL *now, const REAL *before, long count)
{
    fprintf(stderr, "BROKEN PROMISE of %s, status %d: %s; now and before:", function, status, promise);
    while (count-- > 0)
        fprintf(stderr, " %g %g,", (double)*now++, (double)*before++);
    fputc('\n', stderr);
    abort();
}

/* What a status promises: results where it is OK, finite ones; else what was there before. */
static void promised(const char *function, int status, const REAL *now, const REAL *before, long count)
{
    if (status == 0 && !finite_all(now, count))
        broken(function, "a result that is not finite", status, now, before, count);
    if (status != 0 && memcmp(now, before, (size_t)count*sizeof *now) != 0)
        broken(function, "a result was changed", status, now, before, count);
    refusals += status != 0;
}

static void one(void);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    bytes = data;
    left = size;
    used = 0;
    hostile = (int)(byte() % 2);
    hostile_calls += (unsigned long)hostile;
    one();
    calls++;
    while (used > 0)
        free(taken[--used]);
    return 0;
}

static void told(void)
{
    fprintf(stderr, "CALLS %lu, of numbers that nobody should give %lu, results refused %lu\n",
        calls, hostile_calls, refusals);
}

#ifdef ALONE
/* Without libFuzzer: random bytes, so many inputs. */
int main(int argc, char **argv)
{
    unsigned long count = argc > 1 ? strtoul(argv[1], NULL, 10) : 100000, n;
    uint64_t state = argc > 2 ? strtoul(argv[2], NULL, 10) * 2654435769u + 1 : 1;
    uint8_t data[512];
    size_t k;

    for (n = 0; n < count; n++) {
        for (k = 0; k < sizeof data; k++) {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            data[k] = (uint8_t)(state >> 32);
        }
        LLVMFuzzerTestOneInput(data, sizeof data);
    }
    told();
    return 0;
}
#else
int LLVMFuzzerInitialize(int *argc, char ***argv);

int LLVMFuzzerInitialize(int *argc, char ***argv)
{
    (void)argc;
    (void)argv;
    return atexit(told);
}
#endif
