// A Vulkan driver for a device that is not there: it passes to a real driver what describes the device and what
// compiles kernels, and answers everything else itself. Memory is the host's and holds zeros, commands are dropped, and
// a submission is done at once. So a program runs to its end while the real driver compiles all of its pipelines.
//
// NULL_DEVICE_DRIVER is the path of the real driver, which must be able to open its device: Mesa's can, by
// RADV_FORCE_FAMILY or with a kernel interface that is preloaded. Each pipeline whose statistics are asked for is
// written to the folder NULL_DEVICE_KERNELS, if it is set: PROCESS-N.spv, and a line of the file `list` with that, the
// required subgroup size, and its specialization constants as id=bits.

#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>
#include <vulkan/vk_icd.h>
#include <vulkan/vulkan.h>

// ---------------------------------------------------------------------------
// The real driver

static VkResult (*real_negotiate)(uint32_t *version);
static PFN_vk_icdGetInstanceProcAddr real_instance_proc;
static PFN_vk_icdGetInstanceProcAddr real_physical_device_proc;
static PFN_vkGetDeviceProcAddr real_device_proc;
static PFN_vkGetPhysicalDeviceMemoryProperties2 real_memory_properties2;

__attribute__((constructor)) static void open_driver(void) {
    const char *path = getenv("NULL_DEVICE_DRIVER");
    void *driver = path ? dlopen(path, RTLD_NOW | RTLD_LOCAL) : NULL;
    if (!driver) {
        fprintf(stderr, "null-device: %s\n", path ? dlerror() : "NULL_DEVICE_DRIVER names no driver");
        exit(1);
    }
    real_negotiate = (VkResult(*)(uint32_t *))dlsym(driver, "vk_icdNegotiateLoaderICDInterfaceVersion");
    real_instance_proc = (PFN_vk_icdGetInstanceProcAddr)dlsym(driver, "vk_icdGetInstanceProcAddr");
    real_physical_device_proc = (PFN_vk_icdGetInstanceProcAddr)dlsym(driver, "vk_icdGetPhysicalDeviceProcAddr");
    if (!real_negotiate || !real_instance_proc || !real_physical_device_proc) {
        fprintf(stderr, "null-device: %s is no Vulkan driver\n", path);
        exit(1);
    }
}

// ---------------------------------------------------------------------------
// Objects

// Any object of ours. The loader writes its own pointer over the magic number of a command buffer.
typedef struct {
    uintptr_t loader;
    VkDeviceSize size;
    void *memory;
    uint64_t value;
} Object;

static Object *new_object(VkDeviceSize size) {
    Object *object = calloc(1, sizeof *object);
    if (!object) abort();
    object->loader = ICD_LOADER_MAGIC;
    object->size = size;
    return object;
}

// The handle of an object that is not dispatched has 64 bits on every machine.
#define HANDLE(type, object) ((type)(uintptr_t)(object))
#define OBJECT(handle) ((Object *)(uintptr_t)(handle))

static void destroy(VkDevice device, uint64_t handle, const VkAllocationCallbacks *callbacks) {
    (void)device, (void)callbacks;
    free(OBJECT(handle));
}

// Of pools, semaphores and other objects without contents.
static VkResult create(VkDevice device, const void *info, const VkAllocationCallbacks *callbacks, uint64_t *handle) {
    (void)device, (void)info, (void)callbacks;
    *handle = (uint64_t)(uintptr_t)new_object(0);
    return VK_SUCCESS;
}

static VkResult succeed(void) { return VK_SUCCESS; }
static void ignore(void) {}

// ---------------------------------------------------------------------------
// Memory: 16 GiB of the device's, all of which the host sees, and as much of the host's

#define HEAP (16ull << 30)
#define HOST (VK_MEMORY_PROPERTY_HOST_VISIBLE_BIT | VK_MEMORY_PROPERTY_HOST_COHERENT_BIT)

static void memory_properties(VkPhysicalDevice physical, VkPhysicalDeviceMemoryProperties *properties) {
    (void)physical;
    memset(properties, 0, sizeof *properties);
    properties->memoryHeapCount = 2;
    properties->memoryHeaps[0] = (VkMemoryHeap){HEAP, VK_MEMORY_HEAP_DEVICE_LOCAL_BIT};
    properties->memoryHeaps[1] = (VkMemoryHeap){HEAP, 0};
    properties->memoryTypeCount = 3;
    properties->memoryTypes[0] = (VkMemoryType){VK_MEMORY_PROPERTY_DEVICE_LOCAL_BIT, 0};
    properties->memoryTypes[1] = (VkMemoryType){VK_MEMORY_PROPERTY_DEVICE_LOCAL_BIT | HOST, 0};
    properties->memoryTypes[2] = (VkMemoryType){HOST | VK_MEMORY_PROPERTY_HOST_CACHED_BIT, 1};
}

static void memory_properties2(VkPhysicalDevice physical, VkPhysicalDeviceMemoryProperties2 *properties) {
    real_memory_properties2(physical, properties);
    memory_properties(physical, &properties->memoryProperties);
    for (VkBaseOutStructure *next = properties->pNext; next; next = next->pNext) {
        if (next->sType == VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_MEMORY_BUDGET_PROPERTIES_EXT) {
            VkPhysicalDeviceMemoryBudgetPropertiesEXT *budget = (void *)next;
            memset(budget->heapUsage, 0, sizeof budget->heapUsage);
            budget->heapBudget[0] = budget->heapBudget[1] = HEAP;
        }
    }
}

static VkResult allocate(VkDevice device, const VkMemoryAllocateInfo *info, const VkAllocationCallbacks *callbacks,
                         VkDeviceMemory *memory) {
    (void)device, (void)callbacks;
    // A page takes space once it is written.
    int flags = MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE;
    void *pages = mmap(NULL, info->allocationSize, PROT_READ | PROT_WRITE, flags, -1, 0);
    if (pages == MAP_FAILED) return VK_ERROR_OUT_OF_DEVICE_MEMORY;
    Object *object = new_object(info->allocationSize);
    object->memory = pages;
    *memory = HANDLE(VkDeviceMemory, object);
    return VK_SUCCESS;
}

static void free_memory(VkDevice device, VkDeviceMemory memory, const VkAllocationCallbacks *callbacks) {
    (void)device, (void)callbacks;
    if (!memory) return;
    munmap(OBJECT(memory)->memory, OBJECT(memory)->size);
    free(OBJECT(memory));
}

static VkResult map(VkDevice device, VkDeviceMemory memory, VkDeviceSize offset, VkDeviceSize size,
                    VkMemoryMapFlags flags, void **data) {
    (void)device, (void)size, (void)flags;
    *data = (char *)OBJECT(memory)->memory + offset;
    return VK_SUCCESS;
}

static VkResult create_buffer(VkDevice device, const VkBufferCreateInfo *info, const VkAllocationCallbacks *callbacks,
                              VkBuffer *buffer) {
    (void)device, (void)callbacks;
    *buffer = HANDLE(VkBuffer, new_object(info->size));
    return VK_SUCCESS;
}

static void buffer_requirements(VkDevice device, VkBuffer buffer, VkMemoryRequirements *requirements) {
    (void)device;
    *requirements = (VkMemoryRequirements){(OBJECT(buffer)->size + 255) & ~255ull, 256, 7};
}

// ---------------------------------------------------------------------------
// Descriptors, commands, submissions

static VkResult allocate_sets(VkDevice device, const VkDescriptorSetAllocateInfo *info, VkDescriptorSet *sets) {
    (void)device;
    for (uint32_t i = 0; i < info->descriptorSetCount; i++) sets[i] = HANDLE(VkDescriptorSet, new_object(0));
    return VK_SUCCESS;
}

static VkResult allocate_commands(VkDevice device, const VkCommandBufferAllocateInfo *info, VkCommandBuffer *commands) {
    (void)device;
    for (uint32_t i = 0; i < info->commandBufferCount; i++) commands[i] = (VkCommandBuffer)new_object(0);
    return VK_SUCCESS;
}

static VkResult submit(VkQueue queue, uint32_t count, const VkSubmitInfo2 *submissions, VkFence fence) {
    (void)queue, (void)fence;
    for (uint32_t i = 0; i < count; i++) {
        for (uint32_t j = 0; j < submissions[i].signalSemaphoreInfoCount; j++) {
            const VkSemaphoreSubmitInfo *signal = &submissions[i].pSignalSemaphoreInfos[j];
            OBJECT(signal->semaphore)->value = signal->value;
        }
    }
    return VK_SUCCESS;
}

static VkResult counter(VkDevice device, VkSemaphore semaphore, uint64_t *value) {
    (void)device;
    *value = OBJECT(semaphore)->value;
    return VK_SUCCESS;
}

// Timestamps a thousand ticks apart.
static VkResult query_results(VkDevice device, VkQueryPool pool, uint32_t first, uint32_t count, size_t size,
                              void *data, VkDeviceSize stride, VkQueryResultFlags flags) {
    (void)device, (void)pool, (void)flags;
    for (uint32_t i = 0; i < count && i * stride + sizeof(uint64_t) <= size; i++) {
        uint64_t ticks = 1000ull * (first + i);
        memcpy((char *)data + i * stride, &ticks, sizeof ticks);
    }
    return VK_SUCCESS;
}

// ---------------------------------------------------------------------------
// Pipelines for other compilers. A module is written when its pipeline is created, from a copy of its code.

static PFN_vkCreateShaderModule real_create_module;
static PFN_vkCreateComputePipelines real_create_pipelines;
static struct {
    VkShaderModule module;
    size_t size;
    void *code;
} latest[64];
static unsigned modules;

static VkResult create_module(VkDevice device, const VkShaderModuleCreateInfo *info,
                              const VkAllocationCallbacks *callbacks, VkShaderModule *module) {
    VkResult result = real_create_module(device, info, callbacks, module);
    unsigned at = __atomic_fetch_add(&modules, 1, __ATOMIC_RELAXED) % (sizeof latest / sizeof *latest);
    // One that was destroyed may have had the same handle.
    for (size_t i = 0; result == VK_SUCCESS && i < sizeof latest / sizeof *latest; i++)
        if (latest[i].module == *module) latest[i].module = VK_NULL_HANDLE;
    if (result == VK_SUCCESS && getenv("NULL_DEVICE_KERNELS")) {
        latest[at].module = *module;
        latest[at].size = info->codeSize;
        latest[at].code = realloc(latest[at].code, info->codeSize);
        memcpy(latest[at].code, info->pCode, info->codeSize);
    }
    return result;
}

static void write_pipeline(const char *folder, const VkPipelineShaderStageCreateInfo *stage) {
    static unsigned number;
    char path[4096];
    snprintf(path, sizeof path, "%s/%d-%u.spv", folder, getpid(), number);
    FILE *file = fopen(path, "wb");
    for (size_t i = 0; file && i < sizeof latest / sizeof *latest; i++)
        if (latest[i].module == stage->module) {
            rewind(file);
            fwrite(latest[i].code, 1, latest[i].size, file);
        }
    if (file) fclose(file);
    snprintf(path, sizeof path, "%s/list", folder);
    FILE *list = fopen(path, "a");
    if (!list) return;
    uint32_t lanes = 0;
    for (const VkBaseInStructure *next = stage->pNext; next; next = next->pNext)
        if (next->sType == VK_STRUCTURE_TYPE_PIPELINE_SHADER_STAGE_REQUIRED_SUBGROUP_SIZE_CREATE_INFO)
            lanes = ((const VkPipelineShaderStageRequiredSubgroupSizeCreateInfo *)next)->requiredSubgroupSize;
    // A device of one size is not told it.
    if (!lanes && stage->flags & VK_PIPELINE_SHADER_STAGE_CREATE_REQUIRE_FULL_SUBGROUPS_BIT) lanes = 64;
    fprintf(list, "%d-%u.spv %u", getpid(), number++, lanes);
    const VkSpecializationInfo *constants = stage->pSpecializationInfo;
    for (uint32_t i = 0; constants && i < constants->mapEntryCount; i++) {
        uint32_t bits;
        memcpy(&bits, (const char *)constants->pData + constants->pMapEntries[i].offset, sizeof bits);
        fprintf(list, " %u=%u", constants->pMapEntries[i].constantID, bits);
    }
    fprintf(list, "\n");
    fclose(list);
}

static VkResult create_pipelines(VkDevice device, VkPipelineCache cache, uint32_t count,
                                 const VkComputePipelineCreateInfo *infos, const VkAllocationCallbacks *callbacks,
                                 VkPipeline *pipelines) {
    const char *folder = getenv("NULL_DEVICE_KERNELS");
    for (uint32_t i = 0; folder && i < count; i++)
        if (infos[i].flags & VK_PIPELINE_CREATE_CAPTURE_STATISTICS_BIT_KHR) write_pipeline(folder, &infos[i].stage);
    return real_create_pipelines(device, cache, count, infos, callbacks, pipelines);
}

// ---------------------------------------------------------------------------
// The functions

static PFN_vkVoidFunction device_proc(VkDevice device, const char *name);

static const struct {
    const char *name;
    PFN_vkVoidFunction function;
} OURS[] = {
#define FUNCTION(name, function) {"vk" #name, (PFN_vkVoidFunction)function}
    FUNCTION(GetDeviceProcAddr, device_proc),
    FUNCTION(CreateShaderModule, create_module),
    FUNCTION(CreateComputePipelines, create_pipelines),
    FUNCTION(GetPhysicalDeviceMemoryProperties, memory_properties),
    FUNCTION(GetPhysicalDeviceMemoryProperties2, memory_properties2),
    FUNCTION(AllocateMemory, allocate),
    FUNCTION(FreeMemory, free_memory),
    FUNCTION(MapMemory, map),
    FUNCTION(UnmapMemory, ignore),
    FUNCTION(CreateBuffer, create_buffer),
    FUNCTION(DestroyBuffer, destroy),
    FUNCTION(GetBufferMemoryRequirements, buffer_requirements),
    FUNCTION(BindBufferMemory, succeed),
    FUNCTION(CreateDescriptorPool, create),
    FUNCTION(DestroyDescriptorPool, destroy),
    FUNCTION(AllocateDescriptorSets, allocate_sets),
    FUNCTION(UpdateDescriptorSets, ignore),
    FUNCTION(CreateCommandPool, create),
    FUNCTION(DestroyCommandPool, destroy),
    FUNCTION(AllocateCommandBuffers, allocate_commands),
    FUNCTION(BeginCommandBuffer, succeed),
    FUNCTION(EndCommandBuffer, succeed),
    FUNCTION(CreateQueryPool, create),
    FUNCTION(DestroyQueryPool, destroy),
    FUNCTION(ResetQueryPool, ignore),
    FUNCTION(GetQueryPoolResults, query_results),
    FUNCTION(CreateSemaphore, create),
    FUNCTION(DestroySemaphore, destroy),
    FUNCTION(GetSemaphoreCounterValue, counter),
    FUNCTION(WaitSemaphores, succeed),
    FUNCTION(QueueSubmit2, submit),
    FUNCTION(DeviceWaitIdle, succeed),
};

// Ours in place of the real one, if that exists.
static PFN_vkVoidFunction ours(const char *name, PFN_vkVoidFunction real) {
    if (!real) return NULL;
    if (!strncmp(name, "vkCmd", 5)) return ignore;
    size_t length = strlen(name);
    // An extension that is part of Vulkan by now.
    if (length > 3 && !strcmp(name + length - 3, "KHR")) length -= 3;
    for (size_t i = 0; i < sizeof OURS / sizeof *OURS; i++) {
        if (strlen(OURS[i].name) == length && !strncmp(OURS[i].name, name, length)) {
            if (OURS[i].function == (PFN_vkVoidFunction)device_proc) real_device_proc = (PFN_vkGetDeviceProcAddr)real;
            if (OURS[i].function == (PFN_vkVoidFunction)memory_properties2)
                real_memory_properties2 = (PFN_vkGetPhysicalDeviceMemoryProperties2)real;
            if (OURS[i].function == (PFN_vkVoidFunction)create_module)
                real_create_module = (PFN_vkCreateShaderModule)real;
            if (OURS[i].function == (PFN_vkVoidFunction)create_pipelines)
                real_create_pipelines = (PFN_vkCreateComputePipelines)real;
            return OURS[i].function;
        }
    }
    return real;
}

static PFN_vkVoidFunction device_proc(VkDevice device, const char *name) {
    return ours(name, real_device_proc(device, name));
}

VKAPI_ATTR PFN_vkVoidFunction VKAPI_CALL vk_icdGetInstanceProcAddr(VkInstance instance, const char *name) {
    return ours(name, real_instance_proc(instance, name));
}

VKAPI_ATTR PFN_vkVoidFunction VKAPI_CALL vk_icdGetPhysicalDeviceProcAddr(VkInstance instance, const char *name) {
    return ours(name, real_physical_device_proc(instance, name));
}

VKAPI_ATTR VkResult VKAPI_CALL vk_icdNegotiateLoaderICDInterfaceVersion(uint32_t *version) {
    return real_negotiate(version);
}
