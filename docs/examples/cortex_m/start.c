/*
 * The start of a Cortex-M for programs in QEMU: vectors, the FPU switched on, newlib's own start.
 * A board brings its own of its maker.
 */
#include <stdint.h>

extern uint32_t stack_top[]; /* of mps2.ld */
extern void _start(void);

static void reset(void)
{
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* CPACR: full access to the FPU */
    __asm volatile("dsb\n\tisb");
    _start();
}

static void fault(void)
{
    for (;;)
        ;
}

/* stack, reset, NMI, HardFault, MemManage, BusFault, UsageFault */
__attribute__((section(".vectors"), used)) static const uintptr_t vectors[16] = {
    (uintptr_t)stack_top, (uintptr_t)reset, (uintptr_t)fault, (uintptr_t)fault, (uintptr_t)fault,
    (uintptr_t)fault, (uintptr_t)fault,
};
