// count.c - a plugin for QEMU 7 (interface version 1) that prints how many instructions a program executed.
//   gcc -shared -fPIC count.c -o count.so && qemu-aarch64 -d plugin -plugin ./count.so PROGRAM
#include <inttypes.h>
#include <stdint.h>
#include <stdio.h>

// Of qemu-plugin.h, which Debian does not package.
struct qemu_plugin_tb;
void qemu_plugin_register_vcpu_tb_trans_cb(uint64_t id, void (*fn)(uint64_t id, struct qemu_plugin_tb* block));
size_t qemu_plugin_tb_n_insns(const struct qemu_plugin_tb* block);
void qemu_plugin_register_vcpu_tb_exec_inline(struct qemu_plugin_tb* block, int op, void* at, uint64_t value);
void qemu_plugin_register_atexit_cb(uint64_t id, void (*fn)(uint64_t id, void* user), void* user);
void qemu_plugin_outs(const char* text);

__attribute__((visibility("default"))) int qemu_plugin_version = 1;
__attribute__((visibility("default"))) int qemu_plugin_install(uint64_t id, const void* info, int argc, char** argv);

static uint64_t executed;

static void on_block(uint64_t id, struct qemu_plugin_tb* block) {
    (void)id;
    qemu_plugin_register_vcpu_tb_exec_inline(block, 0, &executed, qemu_plugin_tb_n_insns(block)); // 0: add
}

static void on_exit_of(uint64_t id, void* user) {
    char text[64];
    (void)id, (void)user;
    snprintf(text, sizeof text, "instructions %" PRIu64 "\n", executed);
    qemu_plugin_outs(text);
}

int qemu_plugin_install(uint64_t id, const void* info, int argc, char** argv) {
    (void)info, (void)argc, (void)argv;
    qemu_plugin_register_vcpu_tb_trans_cb(id, on_block);
    qemu_plugin_register_atexit_cb(id, on_exit_of, NULL);
    return 0;
}
