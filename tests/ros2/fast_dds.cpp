// A reader or writer of raw bytes on Fast DDS, the library under ROS 2's default: the counterpart of ros2_dds.py.
//
//   fast_dds read  TOPIC TYPE durable|volatile        each sample and each writer as a line, until standard input ends
//   fast_dds write TOPIC TYPE reliable|best_effort    each line of hexadecimal digits from standard input as a sample

#include <cstring>
#include <iostream>
#include <mutex>
#include <string>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/domain/DomainParticipantListener.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;
using eprosima::fastrtps::rtps::WriterDiscoveryInfo;
using Bytes = std::vector<uint8_t>;

static std::mutex output;

static void say(const std::string& line) {
    std::lock_guard<std::mutex> guard(output);
    std::cout << line << std::endl;
}

class Raw : public TopicDataType {
public:
    explicit Raw(const std::string& name) {
        setName(name.c_str());
        m_typeSize = 1 << 20;
        m_isGetKeyDefined = false;
    }
    bool serialize(void* data, SerializedPayload_t* payload) override {
        const auto& bytes = *static_cast<Bytes*>(data);
        std::memcpy(payload->data, bytes.data(), bytes.size());
        payload->length = bytes.size();
        payload->encapsulation = CDR_LE;
        return true;
    }
    bool deserialize(SerializedPayload_t* payload, void* data) override {
        static_cast<Bytes*>(data)->assign(payload->data, payload->data + payload->length);
        return true;
    }
    std::function<uint32_t()> getSerializedSizeProvider(void* data) override {
        return [data] { return uint32_t(static_cast<Bytes*>(data)->size()); };
    }
    void* createData() override { return new Bytes; }
    void deleteData(void* data) override { delete static_cast<Bytes*>(data); }
    bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};

struct Samples : DataReaderListener {
    void on_data_available(DataReader* reader) override {
        Bytes bytes;
        SampleInfo info;
        while (reader->take_next_sample(&bytes, &info) == ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data) continue;
            std::string line = "sample ";
            for (uint8_t byte : bytes) {
                line += "0123456789abcdef"[byte >> 4];
                line += "0123456789abcdef"[byte & 15];
            }
            say(line);
        }
    }
};

struct Writers : DomainParticipantListener {
    void on_publisher_discovery(DomainParticipant*, WriterDiscoveryInfo&& found) override {
        const auto& data = found.info.m_qos.m_userData;
        say("writer " + std::string(found.info.topicName().c_str()) + " " + found.info.typeName().c_str() + " "
            + (data.empty() ? "-" : std::string(data.begin(), data.end())));
    }
};

int main(int argc, char** argv) {
    if (argc != 5) return 2;
    const std::string kind = argv[1], quality = argv[4];
    Writers writers;
    auto* participant = DomainParticipantFactory::get_instance()->create_participant(
        0, PARTICIPANT_QOS_DEFAULT, &writers, StatusMask::none());
    TypeSupport type(new Raw(argv[3]));
    type.register_type(participant);
    auto* topic = participant->create_topic(argv[2], argv[3], TOPIC_QOS_DEFAULT);
    std::string line;
    if (kind == "read") {
        Samples samples;
        DataReaderQos qos = DATAREADER_QOS_DEFAULT;
        qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
        if (quality == "durable") qos.durability().kind = TRANSIENT_LOCAL_DURABILITY_QOS;
        qos.history().depth = 10;
        qos.endpoint().history_memory_policy = eprosima::fastrtps::rtps::DYNAMIC_RESERVE_MEMORY_MODE;
        auto* reader = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(topic, qos, &samples);
        if (reader == nullptr) return 3;
        while (std::getline(std::cin, line)) {}
        participant->delete_contained_entities();
        return 0;
    }
    DataWriterQos qos = DATAWRITER_QOS_DEFAULT;
    qos.reliability().kind = quality == "reliable" ? RELIABLE_RELIABILITY_QOS : BEST_EFFORT_RELIABILITY_QOS;
    qos.endpoint().history_memory_policy = eprosima::fastrtps::rtps::DYNAMIC_RESERVE_MEMORY_MODE;
    auto* writer = participant->create_publisher(PUBLISHER_QOS_DEFAULT)->create_datawriter(topic, qos);
    if (writer == nullptr) return 3;
    while (std::getline(std::cin, line)) {
        Bytes bytes;
        for (size_t at = 0; at + 1 < line.size(); at += 2) bytes.push_back(std::stoi(line.substr(at, 2), nullptr, 16));
        writer->write(&bytes);
    }
    participant->delete_contained_entities();
    return 0;
}
