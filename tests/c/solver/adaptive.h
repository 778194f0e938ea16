/* The files of the library for runs with adaptive steps or events, in the order in which C needs them. */
#include "state.c"
#if EOM_ADAPTIVE
#include "linear.c"
#include "gauss_sweep.c"
#include "increments.c"
#endif
#include "types.h"
#if EOM_ADAPTIVE
#include "gauss.c"
#include "step_size.c"
#include "newton.c"
#include "iteration.c"
#endif
#if EOM_KINKS
#include "discontinuity.c"
#endif
#if EOM_ADAPTIVE
#include "adaptive_step.c"
#endif
#if EOM_EVENTS
#include "fixed_step.c"
#include "series.c"
#include "events.c"
#include "jumps.c"
#endif
#include "run.c"
