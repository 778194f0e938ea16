/*
 * A scene's numbers on a machine that only an emulator has: agreement.py compares them.
 *
 *     cc -DHEADER='<four_bar.h>' -DSCENE=four_bar -DNQ=3 -DREAL=double agreement.c four_bar.c -lm
 *     a.out count steps h batch_steps < states
 *
 * Prints accelerations of each state; the end of a run of RK4 from the scene's start; the ends of a
 * batch, and of its instances one by one; 1 where the batch in three parts has the same bits.
 */
#include HEADER

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MOST 64
#define JOINED(a, b) a##b
#define PASTED(a, b) JOINED(a, b)
#define OF(what) PASTED(SCENE, what)

#if INPUTS /* by the scene's signals */
#define U NULL,
#define STEADY NULL, 0,
#define ALL_STEADY NULL, 0, 0,
#else
#define U
#define STEADY
#define ALL_STEADY
#endif

typedef NUMBER rows[MOST][SIZE];

static void print(const NUMBER x[SIZE])
{
    int i;

    for (i = 0; i < SIZE; i++)
        printf("%.17g\n", (double)x[i]);
}

static void read_state(NUMBER x[SIZE])
{
    double value;
    int i;

    for (i = 0; i < SIZE; i++) {
        if (scanf("%lf", &value) != 1)
            exit(2);
        x[i] = (NUMBER)value;
    }
}

static void must(int status)
{
    if (status) {
        fprintf(stderr, "status %d\n", status);
        exit(3);
    }
}

static void batch(long first, long count, NUMBER h, long steps, rows q, rows qd)
{
    long done[MOST] = {0}, k;
    int status[MOST] = {0};
    NUMBER kept[2*MOST*SIZE];

    OF(_rk4_batch)(count, q[first], qd[first], h, 0, steps, ALL_STEADY 0, kept, kept, 1,
        &OF(_defaults), 0, done, status);
    for (k = 0; k < count; k++)
        must(status[k]);
}

static void run(NUMBER h, long steps, NUMBER q[SIZE], NUMBER qd[SIZE])
{
    OF(_status) status = 0;

    OF(_rk4_run)(q, qd, h, 0, steps, STEADY 0, NULL, NULL, &OF(_defaults), NULL, &status);
    must((int)status);
}

int main(int argc, char **argv)
{
    static rows q, qd, one_q, one_qd, part_q, part_qd;
    NUMBER a[SIZE], h;
    long count, steps, few, k;

    if (argc != 5)
        return 2;
    count = atol(argv[1]), steps = atol(argv[2]), h = (NUMBER)atof(argv[3]), few = atol(argv[4]);
    if (count < 3 || count > MOST)
        return 2;
    for (k = 0; k < count; k++) {
        read_state(q[k]);
        read_state(qd[k]);
        must((int)OF(_acceleration)(a, q[k], qd[k], U &OF(_defaults)));
        print(a);
    }
    memcpy(part_q, q, sizeof q), memcpy(part_qd, qd, sizeof qd);
    memcpy(one_q[0], OF(_q0), sizeof a), memcpy(one_qd[0], OF(_qd0), sizeof a);
    run(h, steps, one_q[0], one_qd[0]);
    print(one_q[0]);
    print(one_qd[0]);
    memcpy(one_q, q, sizeof q), memcpy(one_qd, qd, sizeof qd);
    batch(0, count, h, few, q, qd);
    for (k = 0; k < count; k++)
        print(q[k]);
    for (k = 0; k < count; k++) {
        run(h, few, one_q[k], one_qd[k]);
        print(one_q[k]);
    }
    batch(0, count/3, h, few, part_q, part_qd);
    batch(count/3, 1, h, few, part_q, part_qd);
    batch(count/3 + 1, count - count/3 - 1, h, few, part_q, part_qd);
    printf("%d\n", !memcmp(q, part_q, sizeof q) && !memcmp(qd, part_qd, sizeof qd));
    return 0;
}
