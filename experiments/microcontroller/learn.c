/* Learns from the steps of a file; all parameters after each, with what the update took. */
#include "board.h"
#include "policy.h"

extern policy_learner learner; /* learner.c */
void update(const float *step);

int main(void) {
    float step[2 * POLICY_OBSERVATIONS + POLICY_COMMANDS + 3];
    const int in = open_file("rows", READING), out = open_file("results", WRITING);
    if (in < 0 || out < 0 || !write_calibration(out)) return 1;
    policy_begin(&learner);
    while (read_file(in, step, sizeof step)) {
        begin_measurement(stack_pointer());
        update(step);
        const measurement used = end_measurement();
        if (!write_file(out, &learner.parameters, sizeof learner.parameters)) return 1;
        if (!write_file(out, &used, sizeof used)) return 1;
    }
    return 0;
}
