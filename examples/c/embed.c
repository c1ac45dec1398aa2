/* A host in C: lends its Vulkan device, has one frame recorded into its command buffer, and submits it itself.
 *
 *     cc -std=c99 embed.c $(pkg-config --cflags --libs nightsplat vulkan) -o embed
 *     ./embed model.ply out.ppm
 *
 * The library submits nothing and waits for nothing: NSP_DEVICE_RECORD_ONLY.
 */
#include <nightsplat.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <vulkan/vulkan.h>

enum { WIDTH = 320, HEIGHT = 240 };

static VkInstance instance;
static VkPhysicalDevice physical;
static VkDevice device;
static uint32_t family;
static VkQueue queue;
static int failed;

/* Every function of the library returns a code; the text of the last error is one line. */
static int ok(NspResult result) {
    if (result < 0) fprintf(stderr, "%s (%d)\n", nsp_last_error(), (int)result), failed = 1;
    return result >= 0;
}

static void check(VkResult result, const char *call) {
    if (result != VK_SUCCESS) fprintf(stderr, "%s: %d\n", call, (int)result), exit(1);
}
#define VK(call) check(call, #call)

static void open_device(void) {
    VkApplicationInfo app = {.sType = VK_STRUCTURE_TYPE_APPLICATION_INFO, .apiVersion = VK_API_VERSION_1_3};
    VkInstanceCreateInfo create = {.sType = VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO, .pApplicationInfo = &app};
    VK(vkCreateInstance(&create, NULL, &instance));
    uint32_t count = 1;
    vkEnumeratePhysicalDevices(instance, &count, &physical);
    if (count == 0 || !ok(nsp_check_device(vkGetInstanceProcAddr, instance, physical))) exit(1);

    VkQueueFamilyProperties families[16];
    count = 16;
    vkGetPhysicalDeviceQueueFamilyProperties(physical, &count, families);
    while (family < count && !(families[family].queueFlags & VK_QUEUE_COMPUTE_BIT)) family++;

    float priority = 1.0f;
    VkDeviceQueueCreateInfo queues = {.sType = VK_STRUCTURE_TYPE_DEVICE_QUEUE_CREATE_INFO,
                                      .queueFamilyIndex = family,
                                      .queueCount = 1,
                                      .pQueuePriorities = &priority};
    VkDeviceCreateInfo info = {.sType = VK_STRUCTURE_TYPE_DEVICE_CREATE_INFO,
                               .queueCreateInfoCount = 1,
                               .pQueueCreateInfos = &queues};
    info.ppEnabledExtensionNames = nsp_device_extensions(&info.enabledExtensionCount);
    /* After the host's own features: the library adds what it needs and clears none. */
    NspFeatureStructs structs = {.struct_size = sizeof structs};
    if (!ok(nsp_require_features(&info, &structs))) exit(1);
    VK(vkCreateDevice(physical, &info, NULL, &device));
    vkGetDeviceQueue(device, family, 0, &queue);
}

static VkDeviceMemory allocate(VkMemoryRequirements needed, VkMemoryPropertyFlags flags) {
    VkPhysicalDeviceMemoryProperties own;
    vkGetPhysicalDeviceMemoryProperties(physical, &own);
    VkMemoryAllocateInfo info = {.sType = VK_STRUCTURE_TYPE_MEMORY_ALLOCATE_INFO, .allocationSize = needed.size};
    while (!(needed.memoryTypeBits >> info.memoryTypeIndex & 1) ||
           (own.memoryTypes[info.memoryTypeIndex].propertyFlags & flags) != flags)
        info.memoryTypeIndex++;
    VkDeviceMemory memory;
    VK(vkAllocateMemory(device, &info, NULL, &memory));
    return memory;
}

/* A camera that looks along z at the origin, from four units away. */
static NspCamera camera(void) {
    NspCamera own = {.struct_size = sizeof own, .width = WIDTH, .height = HEIGHT, .focal = {300, 300}};
    own.principal_point[0] = WIDTH / 2.0, own.principal_point[1] = HEIGHT / 2.0;
    double pose[12] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4};
    memcpy(own.view_from_world, pose, sizeof pose);
    return own;
}

static void write_ppm(const char *path, const unsigned char *rgba) {
    FILE *file = fopen(path, "wb");
    if (!file) perror(path), exit(1);
    fprintf(file, "P6\n%d %d\n255\n", WIDTH, HEIGHT);
    for (int i = 0; i < WIDTH * HEIGHT; i++) fwrite(rgba + 4 * i, 1, 3, file);
    fclose(file);
}

int main(int argc, char **argv) {
    if (argc != 3) return fprintf(stderr, "usage: embed MODEL.ply OUT.ppm\n"), 2;
    open_device();

    /* The host's own objects: an image, memory to read it, a command buffer, a timeline for its frames. */
    VkImageCreateInfo image_info = {.sType = VK_STRUCTURE_TYPE_IMAGE_CREATE_INFO,
                                    .imageType = VK_IMAGE_TYPE_2D,
                                    .format = VK_FORMAT_R8G8B8A8_UNORM,
                                    .extent = {WIDTH, HEIGHT, 1},
                                    .mipLevels = 1,
                                    .arrayLayers = 1,
                                    .samples = VK_SAMPLE_COUNT_1_BIT,
                                    .usage = VK_IMAGE_USAGE_TRANSFER_DST_BIT | VK_IMAGE_USAGE_TRANSFER_SRC_BIT};
    VkBufferCreateInfo buffer_info = {.sType = VK_STRUCTURE_TYPE_BUFFER_CREATE_INFO,
                                      .size = 4 * WIDTH * HEIGHT,
                                      .usage = VK_BUFFER_USAGE_TRANSFER_DST_BIT};
    VkCommandPoolCreateInfo pool_info = {.sType = VK_STRUCTURE_TYPE_COMMAND_POOL_CREATE_INFO,
                                         .queueFamilyIndex = family};
    VkSemaphoreTypeCreateInfo timeline = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_TYPE_CREATE_INFO,
                                          .semaphoreType = VK_SEMAPHORE_TYPE_TIMELINE};
    VkSemaphoreCreateInfo semaphore_info = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_CREATE_INFO, .pNext = &timeline};
    VkImage image;
    VkBuffer buffer;
    VkCommandPool pool;
    VkSemaphore frames;
    VkMemoryRequirements needed;
    VK(vkCreateImage(device, &image_info, NULL, &image));
    vkGetImageMemoryRequirements(device, image, &needed);
    VkDeviceMemory image_memory = allocate(needed, 0);
    VK(vkBindImageMemory(device, image, image_memory, 0));
    VK(vkCreateBuffer(device, &buffer_info, NULL, &buffer));
    vkGetBufferMemoryRequirements(device, buffer, &needed);
    VkDeviceMemory memory =
        allocate(needed, VK_MEMORY_PROPERTY_HOST_VISIBLE_BIT | VK_MEMORY_PROPERTY_HOST_COHERENT_BIT);
    VK(vkBindBufferMemory(device, buffer, memory, 0));
    VK(vkCreateCommandPool(device, &pool_info, NULL, &pool));
    VK(vkCreateSemaphore(device, &semaphore_info, NULL, &frames));

    /* Lend the device, load a model, make a renderer: nothing of this touches the queue. */
    NspHostDevice host = {.struct_size = sizeof host,
                          .get_instance_proc_addr = vkGetInstanceProcAddr,
                          .instance = instance,
                          .physical_device = physical,
                          .device = device,
                          .queue_family = family,
                          .flags = NSP_DEVICE_RECORD_ONLY,
                          .frames = frames};
    host.extensions = nsp_device_extensions(&host.extension_count);
    NspDevice *lent = NULL;
    NspModel *model = NULL;
    NspRenderer *renderer = NULL;
    if (ok(nsp_device_from_host(&host, &lent)) && ok(nsp_model_load(lent, argv[1], &model)) &&
        ok(nsp_renderer_create(lent, model, &renderer))) {
        VkCommandBufferAllocateInfo commands_info = {.sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_ALLOCATE_INFO,
                                                     .commandPool = pool,
                                                     .commandBufferCount = 1};
        VkCommandBufferBeginInfo begin = {.sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_BEGIN_INFO};
        VkCommandBuffer commands;
        VK(vkAllocateCommandBuffers(device, &commands_info, &commands));
        VK(vkBeginCommandBuffer(commands, &begin));

        /* The host's passes before this one go here. The image is taken from `before` and left in `after`. */
        NspImage color = {.struct_size = sizeof color, .image = image, .format = VK_FORMAT_R8G8B8A8_UNORM};
        color.extent.width = WIDTH, color.extent.height = HEIGHT;
        color.before.layout = VK_IMAGE_LAYOUT_UNDEFINED;
        color.after.layout = VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL;
        color.after.stages = VK_PIPELINE_STAGE_2_COPY_BIT;
        color.after.access = VK_ACCESS_2_TRANSFER_READ_BIT;
        NspCamera view = camera();
        NspRender render = {.struct_size = sizeof render, .commands = commands, .frame = 1};
        render.cameras = &view, render.camera_count = 1, render.color = &color;
        if (ok(nsp_record_render(renderer, model, &render))) {
            VkBufferImageCopy region = {.imageSubresource = {VK_IMAGE_ASPECT_COLOR_BIT, 0, 0, 1},
                                        .imageExtent = {WIDTH, HEIGHT, 1}};
            vkCmdCopyImageToBuffer(commands, image, VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL, buffer, 1, &region);
            VK(vkEndCommandBuffer(commands));
            uint64_t frame = 1;
            VkTimelineSemaphoreSubmitInfo values = {.sType = VK_STRUCTURE_TYPE_TIMELINE_SEMAPHORE_SUBMIT_INFO,
                                                    .signalSemaphoreValueCount = 1,
                                                    .pSignalSemaphoreValues = &frame};
            VkSubmitInfo submit = {.sType = VK_STRUCTURE_TYPE_SUBMIT_INFO, .pNext = &values, .commandBufferCount = 1};
            submit.pCommandBuffers = &commands, submit.signalSemaphoreCount = 1, submit.pSignalSemaphores = &frames;
            VK(vkQueueSubmit(queue, 1, &submit, VK_NULL_HANDLE));
            VK(vkQueueWaitIdle(queue));
            void *pixels;
            VK(vkMapMemory(device, memory, 0, VK_WHOLE_SIZE, 0, &pixels));
            write_ppm(argv[2], pixels);
        }
    }
    nsp_renderer_destroy(renderer); /* each also takes NULL, and may go with frames in flight */
    nsp_model_destroy(model);
    nsp_device_destroy(lent); /* last, when every frame is done */
    vkDestroySemaphore(device, frames, NULL);
    vkDestroyCommandPool(device, pool, NULL);
    vkDestroyBuffer(device, buffer, NULL);
    vkFreeMemory(device, memory, NULL);
    vkDestroyImage(device, image, NULL);
    vkFreeMemory(device, image_memory, NULL);
    vkDestroyDevice(device, NULL);
    vkDestroyInstance(instance, NULL);
    return failed;
}
