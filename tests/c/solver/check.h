/* Checks of tests in C. A test's main returns the number of failed checks. */
#ifndef CHECK_H
#define CHECK_H

#include <stdio.h>

static int failures = 0;

/* Report a condition that does not hold, with a number that explains it. */
#define CHECK(condition, number) \
    do { \
        if (!(condition)) { \
            printf("%s:%d: %s: %.17g\n", __FILE__, __LINE__, #condition, (double)(number)); \
            failures++; \
        } \
    } while (0)

/* A random number between -1 and 1, the same ones in each run (Marsaglia, J. Stat. Software 8 (2003), 14). */
static inline double draw(void)
{
    static unsigned long long state = 88172645463325252ULL;

    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return (double)(state >> 11)/4503599627370496.0 - 1;
}

#endif
