/* From reset to main: what a vendor's start-up file does, for any Cortex-M, in as little as will do. */
#include <stdint.h>

#include "board.h"

int main(void);
void reset(void);
static void fault(void);

extern uint32_t stack_top[], data_begin[], data_end[], data_in_flash[], bss_begin[], bss_end[]; /* link.ld */

typedef void (*vector)(void);

/* The core reads the first two words at reset: the stack pointer, and where to begin. The others are exceptions. */
__attribute__((section(".vectors"), used)) static const vector vectors[16] = {
    (vector)(uintptr_t)stack_top, reset, fault, fault, fault, fault, fault, fault,
    fault, fault, fault, fault, fault, fault, fault, fault,
};

void reset(void) {
    for (uint32_t *from = data_in_flash, *to = data_begin; to < data_end;) *to++ = *from++;
    for (uint32_t *word = bss_begin; word < bss_end;) *word++ = 0;
#ifdef __ARM_FP /* there is a floating-point unit; it is off until coprocessors 10 and 11 are allowed */
    *(volatile uint32_t *)0xE000ED88 |= 0xFu << 20;
    __asm__ volatile("dsb\n isb" ::: "memory");
#endif
    leave(main() == 0);
}

/* An instruction that the core does not know, an address that is not there, a floating-point unit that is off. */
static void fault(void) { leave(0); }
