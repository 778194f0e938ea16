/* Types of runs: the state between steps, and attempts at an adaptive step. */

#if EOM_ADAPTIVE
enum {
    EOM_MAX_SWEEPS = 14, /* iterations over the stages, in a step */
    EOM_MIN_SWEEPS = 4, /* iterations before slow convergence ends them */
    EOM_SLOW_SWEEPS = 6, /* iterations of a step that the next one should not need */
    EOM_NEWTON_STEPS = 32, /* steps by Newton's method before fixed-point iteration is tried again */
    EOM_STIFF_VOTES = 6, /* indications of stiffness that start Newton's method */
    EOM_MAX_VOTES = 8 /* their largest number */
};

/* How the iteration over the stages of a step ended; not converged: the step is too long or its error too large. */
typedef enum { EOM_CONVERGED, EOM_NOT_CONVERGED, EOM_UNDEFINED } eom_outcome;

#endif
#if EOM_EVENTS
/* The state of an event between steps. */
typedef struct {
    int sign; /* of the event function; 0: unknown */
#if EOM_JUMPS
    int contact; /* its sign before the last jump; 0: no jump yet, or it has switched a mode */
#endif
    real offset; /* zero level: value at the last root, until it is left; 0: none */
#if EOM_RECORDS
    real largest; /* largest magnitude so far */
#endif
#if EOM_JUMPS
#if EOM_SEVERAL
    real root_time; /* of the last root */
#endif
    real jump_time, interval; /* of the last jump; between the last two jumps */
#endif
} eom_event_state;

#endif
/* The state of a run. It is stored in the caller's memory between calls. */
typedef struct {
    real q[EOM_WIDTH], qd[EOM_WIDTH], t;
    real q0[EOM_WIDTH], qd0[EOM_WIDTH], t0, size; /* start and size of the last step; 0: none */
#if EOM_ADAPTIVE
    real powers[EOM_NQ][EOM_POWERS]; /* accelerations in the last step: coefficients of powers of 2 (t - t0)/size - 1 */
    real h; /* size of the next step; 0: not yet known */
#else
    real powers[EOM_NQ][EOM_POWERS]; /* coefficients of the interpolant of the last step */
    real h; /* largest size of a step directly after a jump; 0: no limit */
#endif
#if EOM_ADAPTIVE
    real q_rest[EOM_WIDTH], qd_rest[EOM_WIDTH], t_rest, t0_rest; /* remainders of compensated (Kahan) summation */
    real tol; /* tolerance of this call */
    real span; /* time scale: with t it defines the least step size */
    real ideal, ideal_time; /* admissible size of the last step, and the time at its middle; ideal 0: none */
    int steps_since_restart; /* at most 2 */
    int stiff_votes, newton_steps, used_newton; /* indications of stiffness; remaining steps by Newton's method; whether it solved the last step */
#if EOM_CONSTRAINTS
    int used_projection; /* whether the stages of the last step were projected onto the constraints */
#endif
#if EOM_KINKS
    real max_q[EOM_WIDTH], max_qd[EOM_WIDTH]; /* largest magnitudes of coordinates and velocities so far */
    real first_kink_time, skipped_kink_time; /* time of the first of the recent steps with a kink; of the last step that skipped one */
    int kink, recent_kinks, skipped_kinks; /* whether the last step has a kink; number of recent steps with kinks, and of recent skipped ones */
#endif
#endif
#if EOM_EVENTS
#if EOM_ADAPTIVE
    int fixed; /* whether steps are of fixed size */
#endif
#if EOM_METHODS
    eom_method method; /* of fixed steps */
#endif
    eom_event_state event[EOM_NE];
    real last_values[EOM_NE]; /* of the event functions at the end of the last call */
#if EOM_JUMPS
#if EOM_SEVERAL
    real jumped; /* time of the last jump of any event */
#endif
    int simultaneous_jumps; /* number of further jumps at the time of the last one */
#endif
#if EOM_ADAPTIVE
    real part_size; /* size of the last part of a step that resolves the event functions; 0: they are resolved in whole steps */
    real part_start, part_width; /* part of the last step in which events are detected, as fractions */
#endif
    real grid_step, grid_start; /* fixed steps: their size, and the start of the first */
#if EOM_INITIAL_EVENTS
    real by_q[EOM_WIDTH], by_qd[EOM_WIDTH]; /* end of the last fixed step, by quadrature of its accelerations */
#endif
#endif
} eom_run_state;

#if EOM_ADAPTIVE
/*
 * Data of Newton's method in a step: the derivatives of the accelerations by q and qd at its start, by rows, and
 * the factors of 1 - h mu da/dqd - (h mu)^2 da/dq, in real numbers, for one eigenvalue mu of A of each pair.
 */
typedef struct {
    real slopes[2*EOM_NQ*EOM_NQ], lu[EOM_GAUSS_STAGES/2][4*EOM_NQ*EOM_NQ];
    int row[EOM_GAUSS_STAGES/2][2*EOM_NQ];
} eom_newton;

/* The solution of a step for the accelerations at its stages, and what it says about the error. */
typedef struct {
    eom_gauss_stages a;
    eom_newton newton_data;
    int newton; /* whether Newton's method solves the step */
    int sweeps; /* number of iterations */
    real scale[EOM_NQ], coarse[EOM_NQ]; /* see eom_error_scales */
    real rough, beyond; /* see eom_roughness */
#if EOM_CONSTRAINTS
    int project; /* 0, or 1 + the number of rejected steps whose stages were projected onto the constraints */
#endif
#if EOM_REST
    real cap[EOM_NQ]; /* largest scales */
    int capped; /* whether they apply */
#endif
} eom_solution;

/* An attempt at a step. */
typedef struct {
    eom_solution x;
    eom_outcome outcome;
    real f[EOM_WIDTH]; /* accelerations at the start of the step */
    real h, planned; /* size, and that of the first attempt */
    real factor; /* admissible size, relative to h */
    int ends; /* whether the step ends at the end of the run */
    int rejected, newton_failures; /* whether an attempt was rejected; number of failures of Newton's method */
#if EOM_KINKS
    int starts_constant; /* whether the iteration starts from the accelerations at the start */
    real least; /* size below which a step is not reduced */
    real end_f[EOM_WIDTH]; /* accelerations at the end */
    real kink_error; /* error by a kink, relative to the part of the tolerance that applies to it */
#endif
#if EOM_REST
    int measured; /* whether rounding errors have been measured */
#endif
} eom_attempt;

#endif
