/* What both processes of share.c need of Vulkan: instance, device, timeline, images that are shared, and memory to read
 * them through. */
#include <nightsplat.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define WIDTH 320
#define HEIGHT 240
#define BYTES (8 * WIDTH * HEIGHT)
#define RING 3
#define MEMORY_FD VK_EXTERNAL_MEMORY_HANDLE_TYPE_OPAQUE_FD_BIT
#define SEMAPHORE_FD VK_EXTERNAL_SEMAPHORE_HANDLE_TYPE_OPAQUE_FD_BIT
#define COUNT(array) (sizeof(array) / sizeof *(array))

static void fail(const char *what, const char *why)
{
    fprintf(stderr, "share: %s: %s\n", what, why);
    exit(1);
}
#define VK(call) do { if ((call) != VK_SUCCESS) fail(#call, "failed"); } while (0)
#define NSP(call) do { if ((call) < 0) fail(#call, nsp_last_error()); } while (0)

/* A device and its driver: memory of another one cannot be imported. */
typedef struct { uint8_t device[VK_UUID_SIZE], driver[VK_UUID_SIZE]; int has_semaphore; } Hello;

typedef struct {
    VkInstance instance;
    VkPhysicalDevice physical;
    VkDevice device;
    VkQueue queue;
    uint32_t family, extension_count;
    VkCommandPool pool;
    VkSemaphore frames;   /* a timeline that reaches the number of each frame */
    VkSemaphore timeline; /* the other process's */
    const char *extensions[8];
    Hello hello;
} Gpu;

static int has_extension(VkPhysicalDevice physical, const char *name)
{
    uint32_t count = 0;
    VK(vkEnumerateDeviceExtensionProperties(physical, NULL, &count, NULL));
    VkExtensionProperties *all = calloc(count, sizeof *all);
    VK(vkEnumerateDeviceExtensionProperties(physical, NULL, &count, all));
    int found = 0;
    for (uint32_t i = 0; i < count; i++) found |= !strcmp(all[i].extensionName, name);
    free(all);
    return found;
}

/* The device that `wanted` names by both of its UUIDs; without it the first one. */
static VkPhysicalDevice find_device(VkInstance instance, const Hello *wanted, Hello *hello)
{
    VkPhysicalDevice all[16];
    uint32_t count = COUNT(all);
    if (vkEnumeratePhysicalDevices(instance, &count, all) < 0) fail("vkEnumeratePhysicalDevices", "failed");
    for (uint32_t i = 0; i < count; i++) {
        VkPhysicalDeviceIDProperties id = {.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_ID_PROPERTIES};
        VkPhysicalDeviceProperties2 info = {.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_PROPERTIES_2, .pNext = &id};
        vkGetPhysicalDeviceProperties2(all[i], &info);
        memcpy(hello->device, id.deviceUUID, VK_UUID_SIZE);
        memcpy(hello->driver, id.driverUUID, VK_UUID_SIZE);
        if (!wanted || !memcmp(hello, wanted, 2 * VK_UUID_SIZE)) return all[i];
    }
    fail("find_device", wanted ? "the renderer's device is not here, or has another driver" : "no Vulkan device");
    return VK_NULL_HANDLE;
}

static int shares_timelines(VkPhysicalDevice physical)
{
    VkSemaphoreTypeCreateInfo kind = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_TYPE_CREATE_INFO,
                                      .semaphoreType = VK_SEMAPHORE_TYPE_TIMELINE};
    VkPhysicalDeviceExternalSemaphoreInfo info = {.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_EXTERNAL_SEMAPHORE_INFO,
                                                  .pNext = &kind, .handleType = SEMAPHORE_FD};
    VkExternalSemaphoreProperties able = {.sType = VK_STRUCTURE_TYPE_EXTERNAL_SEMAPHORE_PROPERTIES};
    vkGetPhysicalDeviceExternalSemaphoreProperties(physical, &info, &able);
    VkExternalSemaphoreFeatureFlags both =
        VK_EXTERNAL_SEMAPHORE_FEATURE_EXPORTABLE_BIT | VK_EXTERNAL_SEMAPHORE_FEATURE_IMPORTABLE_BIT;
    return has_extension(physical, VK_KHR_EXTERNAL_SEMAPHORE_FD_EXTENSION_NAME) &&
           (able.externalSemaphoreFeatures & both) == both;
}

static Gpu open_gpu(const Hello *wanted)
{
    Gpu gpu = {0};
    VkApplicationInfo app = {.sType = VK_STRUCTURE_TYPE_APPLICATION_INFO, .apiVersion = VK_API_VERSION_1_3};
    VkInstanceCreateInfo info = {.sType = VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO, .pApplicationInfo = &app};
    VK(vkCreateInstance(&info, NULL, &gpu.instance));
    gpu.physical = find_device(gpu.instance, wanted, &gpu.hello);
    gpu.hello.has_semaphore = shares_timelines(gpu.physical);
    gpu.extensions[gpu.extension_count++] = VK_KHR_EXTERNAL_MEMORY_FD_EXTENSION_NAME;
    if (gpu.hello.has_semaphore) gpu.extensions[gpu.extension_count++] = VK_KHR_EXTERNAL_SEMAPHORE_FD_EXTENSION_NAME;
    uint32_t optional = 0;
    const char *const *names = nsp_device_extensions(&optional);
    for (uint32_t i = 0; i < optional && gpu.extension_count < COUNT(gpu.extensions); i++)
        if (has_extension(gpu.physical, names[i])) gpu.extensions[gpu.extension_count++] = names[i];

    VkQueueFamilyProperties families[16];
    uint32_t count = COUNT(families);
    vkGetPhysicalDeviceQueueFamilyProperties(gpu.physical, &count, families);
    while (gpu.family < count && !(families[gpu.family].queueFlags & VK_QUEUE_COMPUTE_BIT)) gpu.family++;
    float priority = 1;
    VkDeviceQueueCreateInfo queue = {.sType = VK_STRUCTURE_TYPE_DEVICE_QUEUE_CREATE_INFO,
        .queueFamilyIndex = gpu.family, .queueCount = 1, .pQueuePriorities = &priority};
    VkDeviceCreateInfo device = {.sType = VK_STRUCTURE_TYPE_DEVICE_CREATE_INFO,
        .queueCreateInfoCount = 1, .pQueueCreateInfos = &queue,
        .enabledExtensionCount = gpu.extension_count, .ppEnabledExtensionNames = gpu.extensions};
    NspFeatureStructs structs = {.struct_size = sizeof structs};
    NSP(nsp_require_features(&device, &structs));
    VK(vkCreateDevice(gpu.physical, &device, NULL, &gpu.device));
    vkGetDeviceQueue(gpu.device, gpu.family, 0, &gpu.queue);
    VkCommandPoolCreateInfo pool = {.sType = VK_STRUCTURE_TYPE_COMMAND_POOL_CREATE_INFO,
        .flags = VK_COMMAND_POOL_CREATE_RESET_COMMAND_BUFFER_BIT, .queueFamilyIndex = gpu.family};
    VK(vkCreateCommandPool(gpu.device, &pool, NULL, &gpu.pool));
    VkExportSemaphoreCreateInfo exported = {.sType = VK_STRUCTURE_TYPE_EXPORT_SEMAPHORE_CREATE_INFO,
                                            .handleTypes = SEMAPHORE_FD};
    VkSemaphoreTypeCreateInfo kind = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_TYPE_CREATE_INFO,
        .pNext = gpu.hello.has_semaphore ? &exported : NULL, .semaphoreType = VK_SEMAPHORE_TYPE_TIMELINE};
    VkSemaphoreCreateInfo frames = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_CREATE_INFO, .pNext = &kind};
    VK(vkCreateSemaphore(gpu.device, &frames, NULL, &gpu.frames));
    return gpu;
}

static VkDeviceMemory allocate(const Gpu *gpu, VkMemoryRequirements needed, VkMemoryPropertyFlags flags, void *next)
{
    VkPhysicalDeviceMemoryProperties all;
    vkGetPhysicalDeviceMemoryProperties(gpu->physical, &all);
    uint32_t type = 0;
    while (type < all.memoryTypeCount &&
           !(needed.memoryTypeBits >> type & 1 && (all.memoryTypes[type].propertyFlags & flags) == flags)) type++;
    VkMemoryAllocateInfo info = {.sType = VK_STRUCTURE_TYPE_MEMORY_ALLOCATE_INFO, .pNext = next,
                                 .allocationSize = needed.size, .memoryTypeIndex = type};
    VkDeviceMemory memory;
    VK(vkAllocateMemory(gpu->device, &info, NULL, &memory));
    return memory;
}

typedef struct { VkImage image; VkDeviceMemory memory; } Image;

#define ALONE (-2)
#define EXPORTED (-1)

/* An image of this process alone, or one whose memory is exported, or one that has the memory of a descriptor, which
 * belongs to the driver then. */
static Image make_image(const Gpu *gpu, int descriptor)
{
    Image made;
    VkExternalMemoryImageCreateInfo external = {.sType = VK_STRUCTURE_TYPE_EXTERNAL_MEMORY_IMAGE_CREATE_INFO,
                                                .handleTypes = MEMORY_FD};
    VkImageCreateInfo info = {.sType = VK_STRUCTURE_TYPE_IMAGE_CREATE_INFO,
        .pNext = descriptor == ALONE ? NULL : &external,
        .imageType = VK_IMAGE_TYPE_2D, .format = VK_FORMAT_R16G16B16A16_SFLOAT, .extent = {WIDTH, HEIGHT, 1},
        .mipLevels = 1, .arrayLayers = 1, .samples = VK_SAMPLE_COUNT_1_BIT,
        .usage = VK_IMAGE_USAGE_TRANSFER_DST_BIT | VK_IMAGE_USAGE_TRANSFER_SRC_BIT};
    VK(vkCreateImage(gpu->device, &info, NULL, &made.image));
    VkMemoryDedicatedAllocateInfo dedicated = {.sType = VK_STRUCTURE_TYPE_MEMORY_DEDICATED_ALLOCATE_INFO,
                                               .image = made.image};
    VkExportMemoryAllocateInfo exported = {.sType = VK_STRUCTURE_TYPE_EXPORT_MEMORY_ALLOCATE_INFO,
                                           .pNext = &dedicated, .handleTypes = MEMORY_FD};
    VkImportMemoryFdInfoKHR imported = {.sType = VK_STRUCTURE_TYPE_IMPORT_MEMORY_FD_INFO_KHR, .pNext = &dedicated,
                                        .handleType = MEMORY_FD, .fd = descriptor};
    VkMemoryRequirements needed;
    vkGetImageMemoryRequirements(gpu->device, made.image, &needed);
    void *next = &imported;
    if (descriptor == ALONE) next = &dedicated;
    if (descriptor == EXPORTED) next = &exported;
    made.memory = allocate(gpu, needed, VK_MEMORY_PROPERTY_DEVICE_LOCAL_BIT, next);
    VK(vkBindImageMemory(gpu->device, made.image, made.memory, 0));
    return made;
}

typedef struct { VkBuffer buffer; VkDeviceMemory memory; const uint8_t *bytes; VkCommandBuffer commands; } Slot;

/* Memory to read an image through, with a command buffer. */
static Slot make_slot(const Gpu *gpu)
{
    Slot made;
    void *bytes;
    VkBufferCreateInfo info = {.sType = VK_STRUCTURE_TYPE_BUFFER_CREATE_INFO, .size = BYTES,
                               .usage = VK_BUFFER_USAGE_TRANSFER_DST_BIT};
    VK(vkCreateBuffer(gpu->device, &info, NULL, &made.buffer));
    VkMemoryRequirements needed;
    vkGetBufferMemoryRequirements(gpu->device, made.buffer, &needed);
    VkMemoryPropertyFlags mapped = VK_MEMORY_PROPERTY_HOST_VISIBLE_BIT | VK_MEMORY_PROPERTY_HOST_COHERENT_BIT;
    made.memory = allocate(gpu, needed, mapped, NULL);
    VK(vkBindBufferMemory(gpu->device, made.buffer, made.memory, 0));
    VK(vkMapMemory(gpu->device, made.memory, 0, VK_WHOLE_SIZE, 0, &bytes));
    made.bytes = bytes;
    VkCommandBufferAllocateInfo commands = {.sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_ALLOCATE_INFO,
        .commandPool = gpu->pool, .level = VK_COMMAND_BUFFER_LEVEL_PRIMARY, .commandBufferCount = 1};
    VK(vkAllocateCommandBuffers(gpu->device, &commands, &made.commands));
    return made;
}

static void begin(VkCommandBuffer commands)
{
    VkCommandBufferBeginInfo once = {.sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_BEGIN_INFO,
                                     .flags = VK_COMMAND_BUFFER_USAGE_ONE_TIME_SUBMIT_BIT};
    VK(vkBeginCommandBuffer(commands, &once));
}

/* Records the copy of an image that is the source of one, for the host to read. */
static void read_image(const Slot *slot, VkImage image)
{
    VkBufferImageCopy region = {.imageSubresource = {VK_IMAGE_ASPECT_COLOR_BIT, 0, 0, 1},
                                .imageExtent = {WIDTH, HEIGHT, 1}};
    vkCmdCopyImageToBuffer(slot->commands, image, VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL, slot->buffer, 1, &region);
    VkMemoryBarrier copied = {.sType = VK_STRUCTURE_TYPE_MEMORY_BARRIER,
        .srcAccessMask = VK_ACCESS_TRANSFER_WRITE_BIT, .dstAccessMask = VK_ACCESS_HOST_READ_BIT};
    vkCmdPipelineBarrier(slot->commands, VK_PIPELINE_STAGE_TRANSFER_BIT, VK_PIPELINE_STAGE_HOST_BIT, 0, 1, &copied,
                         0, NULL, 0, NULL);
}

/* Submits; `signal` reaches `value` afterwards. It waits until `wait` has reached `from`, where there is one. */
static void submit(const Gpu *gpu, VkCommandBuffer commands, VkSemaphore wait, uint64_t from, VkSemaphore signal,
                   uint64_t value)
{
    VK(vkEndCommandBuffer(commands));
    VkSemaphoreSubmitInfo before = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_SUBMIT_INFO, .semaphore = wait, .value = from,
                                    .stageMask = VK_PIPELINE_STAGE_2_ALL_COMMANDS_BIT};
    VkSemaphoreSubmitInfo after = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_SUBMIT_INFO, .semaphore = signal,
                                    .value = value, .stageMask = VK_PIPELINE_STAGE_2_ALL_COMMANDS_BIT};
    VkCommandBufferSubmitInfo buffer = {.sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_SUBMIT_INFO,
                                        .commandBuffer = commands};
    VkSubmitInfo2 info = {.sType = VK_STRUCTURE_TYPE_SUBMIT_INFO_2,
        .waitSemaphoreInfoCount = wait != VK_NULL_HANDLE, .pWaitSemaphoreInfos = &before,
        .commandBufferInfoCount = 1, .pCommandBufferInfos = &buffer,
        .signalSemaphoreInfoCount = 1, .pSignalSemaphoreInfos = &after};
    VK(vkQueueSubmit2(gpu->queue, 1, &info, VK_NULL_HANDLE));
}

static void wait_frame(const Gpu *gpu, uint64_t frame)
{
    VkSemaphoreWaitInfo info = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_WAIT_INFO, .semaphoreCount = 1,
                                .pSemaphores = &gpu->frames, .pValues = &frame};
    VK(vkWaitSemaphores(gpu->device, &info, UINT64_MAX));
}

/* -- What crosses the border of a process ------------------------------------------------------------------------- */

#define FUNCTION(gpu, name) ((PFN_##name)vkGetDeviceProcAddr((gpu)->device, #name))

static int memory_descriptor(const Gpu *gpu, VkDeviceMemory memory)
{
    int descriptor = -1;
    VkMemoryGetFdInfoKHR info = {.sType = VK_STRUCTURE_TYPE_MEMORY_GET_FD_INFO_KHR, .memory = memory,
                                 .handleType = MEMORY_FD};
    VK(FUNCTION(gpu, vkGetMemoryFdKHR)(gpu->device, &info, &descriptor));
    return descriptor;
}

static int timeline_descriptor(const Gpu *gpu)
{
    int descriptor = -1;
    VkSemaphoreGetFdInfoKHR info = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_GET_FD_INFO_KHR, .semaphore = gpu->frames,
                                    .handleType = SEMAPHORE_FD};
    VK(FUNCTION(gpu, vkGetSemaphoreFdKHR)(gpu->device, &info, &descriptor));
    return descriptor;
}

static void import_timeline(Gpu *gpu, int descriptor)
{
    VkSemaphoreTypeCreateInfo kind = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_TYPE_CREATE_INFO,
                                      .semaphoreType = VK_SEMAPHORE_TYPE_TIMELINE};
    VkSemaphoreCreateInfo made = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_CREATE_INFO, .pNext = &kind};
    VK(vkCreateSemaphore(gpu->device, &made, NULL, &gpu->timeline));
    VkImportSemaphoreFdInfoKHR info = {.sType = VK_STRUCTURE_TYPE_IMPORT_SEMAPHORE_FD_INFO_KHR,
        .semaphore = gpu->timeline, .handleType = SEMAPHORE_FD, .fd = descriptor};
    VK(FUNCTION(gpu, vkImportSemaphoreFdKHR)(gpu->device, &info));
}

/* The other half of the renderer's release: same layouts. */
static void acquire_external(const Gpu *gpu, VkCommandBuffer commands, VkImage image)
{
    VkImageMemoryBarrier2 barrier = {.sType = VK_STRUCTURE_TYPE_IMAGE_MEMORY_BARRIER_2, .image = image,
        .oldLayout = VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL, .newLayout = VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL,
        .srcQueueFamilyIndex = VK_QUEUE_FAMILY_EXTERNAL, .dstQueueFamilyIndex = gpu->family,
        .dstStageMask = VK_PIPELINE_STAGE_2_ALL_TRANSFER_BIT, .dstAccessMask = VK_ACCESS_2_TRANSFER_READ_BIT,
        .subresourceRange = {VK_IMAGE_ASPECT_COLOR_BIT, 0, 1, 0, 1}};
    VkDependencyInfo info = {.sType = VK_STRUCTURE_TYPE_DEPENDENCY_INFO, .imageMemoryBarrierCount = 1,
                             .pImageMemoryBarriers = &barrier};
    vkCmdPipelineBarrier2(commands, &info);
}

/* -- The end ------------------------------------------------------------------------------------------------------ */

static void free_image(const Gpu *gpu, Image image)
{
    vkDestroyImage(gpu->device, image.image, NULL);
    vkFreeMemory(gpu->device, image.memory, NULL);
}

static void free_slot(const Gpu *gpu, Slot slot)
{
    vkDestroyBuffer(gpu->device, slot.buffer, NULL);
    vkFreeMemory(gpu->device, slot.memory, NULL);
}

static void close_gpu(const Gpu *gpu)
{
    vkDestroySemaphore(gpu->device, gpu->timeline, NULL);
    vkDestroySemaphore(gpu->device, gpu->frames, NULL);
    vkDestroyCommandPool(gpu->device, gpu->pool, NULL);
    vkDestroyDevice(gpu->device, NULL);
    vkDestroyInstance(gpu->instance, NULL);
}
