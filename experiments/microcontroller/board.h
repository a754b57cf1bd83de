/* What the programs need of a board: files of the host, by semihosting, and how much a call takes. */
#ifndef BOARD_H
#define BOARD_H

#include <stdint.h>

typedef enum { READING = 1, WRITING = 5 } file_mode;

/* A file's number, or -1. */
int open_file(const char *name, file_mode mode);

/* Whether all of the bytes were there. */
int read_file(int file, void *bytes, uint32_t count);
int write_file(int file, const void *bytes, uint32_t count);

/* Ends the program, and QEMU. */
void leave(int success);

#define TOO_MANY 0xFFFFFFFFu

/* What a call takes: the program's `begin_measurement(stack_pointer()); f(); used = end_measurement();`. */
typedef struct {
    uint32_t ticks; /* of the core's timer, below 2^24; or TOO_MANY */
    uint32_t stack; /* bytes below the caller's, those of the functions that it calls included; never under 64 */
} measurement;

void begin_measurement(uint32_t *stack);
measurement end_measurement(void);

static inline uint32_t *stack_pointer(void) {
    uint32_t *stack;
    __asm__ volatile("mov %0, sp" : "=r"(stack));
    return stack;
}

/* Writes the ticks of 2,000 and of 2,000,000 instructions: they tell how many one has, and those of a measurement. */
int write_calibration(int file);

#endif
