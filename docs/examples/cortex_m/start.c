/*
 * Startup code of a Cortex-M in QEMU: the vector table, the FPU, and newlib's own start.
 * For a board use the startup code of its manufacturer.
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
