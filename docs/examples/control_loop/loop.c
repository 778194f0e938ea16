/*
 * Balance a cart-pole at 1 kHz for ten minutes: a Kalman filter with noisy positions, an LQR and
 * the plant, all with the generated C. Print the largest deviations and the time of a period.
 *
 *     python gains.py ../balance.toml > gains.h
 *     eomc build ../balance.toml --c balance
 *     cc -std=c99 -O2 -Ibalance loop.c balance/balance.c -lm -o loop && ./loop
 */
#define _POSIX_C_SOURCE 199309L
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "balance.h"
#include "gains.h"

enum { NQ = BALANCE_NQ, NX = 2*NQ, PERIODS = 600000 };

static const double H = 0.001, NOISE = 0.001; /* s; m and rad, of a measurement */

/* The estimate of the filter: the state, and the covariance of its error. */
typedef struct {
    double q[NQ], qd[NQ], P[NX*NX];
} filter;

/* Predict: x = f(x, u), P = Phi P Phi' + W, with the derivatives Phi of the step itself. */
static int predict(filter *f, const double *u, const balance_params *p)
{
    double Phi[NX*NX], Gamma[NX], PhiP[NX*NX];
    int status = (int)balance_rk4_derivative(Phi, Gamma, f->q, f->qd, H, u, p);

    if (!status)
        status = (int)balance_rk4_step(f->q, f->qd, H, u, p);
    if (status)
        return status;
    for (int i = 0; i < NX; i++) {
        for (int j = 0; j < NX; j++) {
            PhiP[NX*i + j] = 0;
            for (int k = 0; k < NX; k++)
                PhiP[NX*i + j] += Phi[NX*i + k]*f->P[NX*k + j];
        }
    }
    for (int i = 0; i < NX; i++) {
        for (int j = 0; j < NX; j++) {
            f->P[NX*i + j] = i == j ? 1e-10 : 0;
            for (int k = 0; k < NX; k++)
                f->P[NX*i + j] += PhiP[NX*i + k]*Phi[NX*j + k];
        }
    }
    return 0;
}

/* Update with one measured position at a time; their noises are independent. */
static void update(filter *f, const double *measured)
{
    for (int m = 0; m < NQ; m++) {
        const double s = f->P[NX*m + m] + NOISE*NOISE, off = measured[m] - f->q[m];
        double gain[NX], row[NX];

        for (int i = 0; i < NX; i++) {
            gain[i] = f->P[NX*i + m]/s;
            row[i] = f->P[NX*m + i];
        }
        for (int i = 0; i < NQ; i++) {
            f->q[i] += gain[i]*off;
            f->qd[i] += gain[NQ + i]*off;
        }
        for (int i = 0; i < NX; i++)
            for (int j = 0; j < NX; j++)
                f->P[NX*i + j] -= gain[i]*row[j];
    }
}

/* One period of the controller: computes the force u from the measured positions. */
static int control(filter *f, double *u, const double *measured, const balance_params *p)
{
    const int status = predict(f, u, p);
    double applied[BALANCE_NU];

    if (status)
        return status;
    update(f, measured);
    u[0] = 0;
    for (int i = 0; i < NQ; i++)
        u[0] -= K[i]*f->q[i] + K[NQ + i]*f->qd[i];
    balance_applied(applied, f->q, f->qd, u, p); /* within the motor's limits */
    u[0] = applied[0];
    return 0;
}

/* The sum of twelve uniform numbers, less six: mean 0, variance 1. */
static double noise(void)
{
    static uint32_t state = 1;
    double sum = -6;

    for (int i = 0; i < 12; i++) {
        state = 1664525u*state + 1013904223u;
        sum += state/4294967296.0;
    }
    return NOISE*sum;
}

static double now(void)
{
    struct timespec t;

    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9*(double)t.tv_nsec;
}

static int compare(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;

    return (x > y) - (x < y);
}

int main(void)
{
    static double took[PERIODS];
    balance_params p = balance_defaults;
    double q[NQ] = { 0.0, 0.2 }, qd[NQ] = { 0.0, 0.0 }, u[BALANCE_NU] = { 0 };
    double worst_angle = 0, error = 0;
    filter f = { { 0.0, 0.0 }, { 0.0, 0.0 }, { 0.0 } };

    for (int i = 0; i < NX; i++)
        f.P[NX*i + i] = 0.1;
    for (long n = 0; n < PERIODS; n++) {
        const double measured[NQ] = { q[0] + noise(), q[1] + noise() }, before = now();

        if (control(&f, u, measured, &p)) {
            printf("the controller stopped in period %ld\n", n);
            return 1;
        }
        took[n] = now() - before;
        if (balance_rk4_step(q, qd, H, u, &p)) {
            printf("the pole is lost in period %ld\n", n);
            return 1;
        }
        if (n >= PERIODS/60) { /* ten seconds for the swing back */
            worst_angle = fmax(worst_angle, fabs(q[BALANCE_THETA]));
            error += pow(qd[BALANCE_THETA] - f.qd[BALANCE_THETA], 2);
        }
    }
    error = sqrt(error/(PERIODS - PERIODS/60));
    qsort(took, PERIODS, sizeof took[0], compare);
    printf("%d periods: angle within %.2g rad, its rate known to %.2g rad/s\n",
           PERIODS, worst_angle, error);
    printf("a period takes %.2g us, one in a thousand %.2g us or more, the worst %.2g us\n",
           1e6*took[PERIODS/2], 1e6*took[PERIODS - PERIODS/1000], 1e6*took[PERIODS - 1]);
    return 0;
}
