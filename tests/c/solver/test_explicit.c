/* Steps of explicit methods. */
#include "model.h"

#include "check.h"
#include "state.c"
#include "explicit.c"

static eom_status advance(real *q, real *qd, real t, real h, const eom_model *m)
{
    return eom_explicit_advance(q, qd, t, h, m);
}

#include "steps.h"

int main(void)
{
    test_steps();
    return failures;
}
