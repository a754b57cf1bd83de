/* Commands for the observations of a file, with what each took. */
#include "board.h"
#include "policy.h"

void command(const float *observation, float *commands); /* controller.c */

int main(void) {
    float observation[POLICY_OBSERVATIONS];
    struct {
        float commands[POLICY_COMMANDS];
        measurement used;
    } record;
    const int in = open_file("rows", READING), out = open_file("results", WRITING);
    if (in < 0 || out < 0 || !write_calibration(out)) return 1;
    while (read_file(in, observation, sizeof observation)) {
        begin_measurement(stack_pointer());
        command(observation, record.commands);
        record.used = end_measurement();
        if (!write_file(out, &record, sizeof record)) return 1;
    }
    return 0;
}
